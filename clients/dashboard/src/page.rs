//! The files of the page, which this program embeds. They need no build step, and fetch nothing from elsewhere.

#[derive(Debug, Clone, Copy)]
pub struct Asset {
    pub path: &'static str,
    pub content_type: &'static str,
    pub text: &'static str,
}

macro_rules! assets {
    ($($path:literal $file:literal $kind:literal),* $(,)?) => {
        [$(Asset {
            path: $path,
            content_type: concat!($kind, "; charset=utf-8"),
            text: include_str!(concat!("../page/", $file)),
        }),*]
    };
}

pub const ASSETS: [Asset; 23] = assets![
    "/" "index.html" "text/html",
    "/page.css" "page.css" "text/css",
    "/icon.svg" "icon.svg" "image/svg+xml",
    "/charts.js" "charts.js" "text/javascript",
    "/controls.js" "controls.js" "text/javascript",
    "/elements.js" "elements.js" "text/javascript",
    "/facts.js" "facts.js" "text/javascript",
    "/inspector.js" "inspector.js" "text/javascript",
    "/land.js" "land.js" "text/javascript",
    "/layout.js" "layout.js" "text/javascript",
    "/legend.js" "legend.js" "text/javascript",
    "/main.js" "main.js" "text/javascript",
    "/overlay.js" "overlay.js" "text/javascript",
    "/palette.js" "palette.js" "text/javascript",
    "/panels.js" "panels.js" "text/javascript",
    "/plot.js" "plot.js" "text/javascript",
    "/pointer.js" "pointer.js" "text/javascript",
    "/robots.js" "robots.js" "text/javascript",
    "/scale.js" "scale.js" "text/javascript",
    "/socket.js" "socket.js" "text/javascript",
    "/view.js" "view.js" "text/javascript",
    "/wire.js" "wire.js" "text/javascript",
    "/words.js" "words.js" "text/javascript",
];

#[cfg(test)]
mod tests {
    use super::*;

    /// A proxy may serve the page below a path. `/main.js` would then belong to another page.
    #[test]
    fn references_between_files_are_relative() {
        for Asset { path, text, .. } in ASSETS {
            for absolute in ["=\"/", "from \"/", "import(\"/", "url(/", "location.host"] {
                assert!(!text.contains(absolute), "{path}: {absolute}");
            }
        }
    }
}
