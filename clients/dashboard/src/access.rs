//! Decides which requests are answered: only requests from the dashboard's own page.
//!
//! The `Host` must be an address, `localhost` or a name given with `--name`. Without this check, a site's owner could
//! point the site's name at this machine, and the site's scripts could read the page (DNS rebinding). The `Origin`,
//! which browsers add to a WebSocket's handshake, must have the same host and port; its scheme is `https` where a proxy
//! adds TLS. `X-Forwarded-*` and `Forwarded` are ignored, because a page on a rebound name could set them.

use axum::http::HeaderMap;
use axum::http::header::{HOST, HeaderName, ORIGIN};
use axum::http::uri::Authority;
use std::net::IpAddr;

/// A host and its port, as in `Host` and in `Origin`.
#[derive(Debug, PartialEq)]
struct Place {
    /// The host, in lower case; an address is in its shortest form, without brackets.
    name: String,
    is_address: bool,
    /// `None` for the scheme's default port.
    port: Option<u16>,
}

/// Checks that a request can have come from the dashboard's page. `names` are host names under which browsers can reach
pub fn check(headers: &HeaderMap, names: &[String]) -> Result<(), String> {
    let text = |name: HeaderName| headers.get(name).map(|it| it.to_str().unwrap_or("?"));
    let host = text(HOST).unwrap_or("");
    let Some(place) = Place::parse(host).filter(|place| place.is_own(names)) else {
        return Err(format!(
            "Host: expected an address, localhost or a name given with --name, got {host:?}"
        ));
    };
    match text(ORIGIN) {
        Some(origin) if !place.has_origin(origin) => Err(format!(
            "Origin: expected \"http://{host}\" or \"https://{host}\", got {origin:?}; a proxy must forward the \
             browser's Host"
        )),
        _ => Ok(()),
    }
}

pub fn host_name(text: &str) -> Result<String, String> {
    let is_part = |byte: u8| byte.is_ascii_alphanumeric() || b".-_".contains(&byte);
    if text.is_empty() || !text.bytes().all(is_part) {
        return Err("expected a host name without scheme and port, such as fire.example".into());
    }
    Ok(text.into())
}

impl Place {
    fn parse(text: &str) -> Option<Self> {
        let authority: Authority = text.parse().ok()?;
        let port = match text.strip_prefix(authority.host())? {
            "" | ":" => None,
            port => Some(port.strip_prefix(':')?.parse().ok()?),
        };
        let host = authority.host();
        let bare = host.strip_prefix('[').and_then(|it| it.strip_suffix(']'));
        let address = bare.unwrap_or(host).parse::<IpAddr>();
        Some(Self {
            is_address: address.is_ok(),
            name: address.map_or_else(|_| host.to_ascii_lowercase(), |it| it.to_string()),
            port,
        })
    }

    /// Returns whether the host is an address, `localhost` or one of `names`, which no stranger can point at this
    /// machine.
    fn is_own(&self, names: &[String]) -> bool {
        let is_own = |name: &String| name.eq_ignore_ascii_case(&self.name);
        self.is_address || self.name == "localhost" || names.iter().any(is_own)
    }

    /// Returns whether an origin has this host and port. A missing port stands for the default port of the origin's
    /// scheme, because a proxy may forward the host without its port.
    fn has_origin(&self, origin: &str) -> bool {
        let (default_port, rest) = match origin.split_once("://") {
            Some(("http", rest)) => (80, rest),
            Some(("https", rest)) => (443, rest),
            _ => return false,
        };
        let port = |place: &Self| place.port.unwrap_or(default_port);
        Self::parse(rest).is_some_and(|page| page.name == self.name && port(&page) == port(self))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn answered(host: &'static str, origin: Option<&'static str>) -> bool {
        let mut headers = HeaderMap::new();
        headers.insert(HOST, HeaderValue::from_static(host));
        headers.extend(origin.map(|origin| (ORIGIN, HeaderValue::from_static(origin))));
        check(&headers, &["Lab.example".to_owned()]).is_ok()
    }

    #[test]
    fn only_hosts_safe_from_rebinding_are_answered() {
        for host in [
            "127.0.0.1:8600",
            "10.0.0.7",
            "[::1]:8600",
            "[fe80::1]",
            "localhost",
            "LOCALHOST:8600",
            "lab.example:80",
            "LAB.example",
            "lab.example:",
        ] {
            assert!(answered(host, None), "{host}");
        }
        for host in [
            "",
            "evil.example:8600",
            "evil.lab.example",
            "lab.example.evil.example",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "evil.example@localhost",
            "localhost@evil.example",
            "localhost:99999",
            "localhost:x",
            "localhost/evil.example",
            "::1",
        ] {
            assert!(!answered(host, None), "{host}");
        }
    }

    #[test]
    fn same_host_and_port_are_answered_with_and_without_tls() {
        for (host, origin) in [
            ("127.0.0.1:8600", "http://127.0.0.1:8600"),
            ("127.0.0.1:8600", "https://127.0.0.1:8600"),
            ("localhost", "http://localhost"),
            ("lab.example", "https://lab.example"),
            ("lab.example:443", "https://lab.example"),
            ("lab.example", "https://lab.example:443"),
            ("lab.example:80", "http://lab.example"),
            ("lab.example:8443", "https://lab.example:8443"),
            ("LAB.Example", "https://lab.example"),
            ("[::1]:8600", "http://[::1]:8600"),
            ("[::1]:443", "https://[::1]"),
            ("[0:0:0:0:0:0:0:1]", "https://[::1]"),
        ] {
            assert!(answered(host, Some(origin)), "{host} {origin}");
        }
    }

    #[test]
    fn other_origins_are_refused() {
        for (host, origin) in [
            ("127.0.0.1:8600", "http://evil.example"),
            ("127.0.0.1:8600", "http://127.0.0.1:8601"),
            ("127.0.0.1:8600", "http://localhost:8600"),
            ("127.0.0.1:8600", "https://127.0.0.1"),
            ("127.0.0.1:8600", "null"),
            ("127.0.0.1:8600", "127.0.0.1:8600"),
            ("127.0.0.1:8600", "ftp://127.0.0.1:8600"),
            ("127.0.0.1:8600", "http://127.0.0.1:8600/"),
            ("127.0.0.1:8600", "http://127.0.0.1:8600@evil.example"),
            ("lab.example", "https://evil.example"),
            ("lab.example", "https://lab.example.evil.example"),
            ("lab.example", "https://evil.lab.example"),
            ("lab.example:80", "https://lab.example"),
            ("lab.example:443", "http://lab.example"),
            ("lab.example", "https://lab.example:8443"),
            ("[::1]:8600", "http://[::2]:8600"),
            ("evil.example", "https://evil.example"),
        ] {
            assert!(!answered(host, Some(origin)), "{host} {origin}");
        }
    }

    #[test]
    fn forwarded_headers_are_ignored() {
        for name in ["x-forwarded-host", "x-forwarded-proto", "forwarded"] {
            let mut headers = HeaderMap::new();
            headers.insert(HOST, HeaderValue::from_static("evil.example"));
            headers.insert(name, HeaderValue::from_static("localhost"));
            assert!(check(&headers, &[]).is_err(), "{name}");
            headers.insert(HOST, HeaderValue::from_static("localhost"));
            headers.insert(name, HeaderValue::from_static("evil.example"));
            assert!(check(&headers, &[]).is_ok(), "{name}");
        }
    }

    #[test]
    fn host_names_have_neither_scheme_nor_port() {
        assert_eq!(host_name("fire.example"), Ok("fire.example".into()));
        for wrong in [
            "",
            "https://fire.example",
            "fire.example:443",
            "fire.example/fire",
            "*.example",
        ] {
            assert!(host_name(wrong).is_err(), "{wrong}");
        }
    }
}
