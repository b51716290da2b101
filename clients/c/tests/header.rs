use std::path::Path;

/// The sources of the header, in the order in which a program uses them.
const SOURCES: [&str; 14] = [
    "../../protocol/messages/src/codes.rs",
    "../../protocol/messages/src/errors.rs",
    "../../protocol/messages/src/message.rs",
    "../../protocol/model/src/path.rs",
    "src/error.rs",
    "src/info.rs",
    "src/server.rs",
    "src/lease.rs",
    "src/report.rs",
    "src/samples.rs",
    "src/belief.rs",
    "src/fork.rs",
    "src/handle.rs",
    "src/view.rs",
];

fn generated(folder: &Path) -> String {
    let config = cbindgen::Config::from_file(folder.join("cbindgen.toml")).expect("settings");
    let builder = cbindgen::Builder::new().with_config(config);
    let add = |builder: cbindgen::Builder, name: &&str| builder.with_src(folder.join(name));
    let bindings = SOURCES.iter().fold(builder, add).generate();
    let mut text = Vec::new();
    bindings.expect("a header").write(&mut text);
    let text = String::from_utf8(text).expect("text");
    // The list of all statuses is no value in C.
    let (enums, rest) = text.split_once("// All statuses").expect("the list");
    let (_, after) = rest.split_once("\n\n").expect("its end");
    // A refusal has the code of its status.
    let (before, rest) = enums
        .split_once("  // The server refused")
        .expect("the class");
    let (_, enums) = rest.split_once(",\n").expect("its end");
    let text = format!("{before}{enums}{after}");
    // The list of all moves is no value in C either.
    let kept = text
        .split("\n\n")
        .filter(|part| !part.contains("ew_move_ALL"));
    without_links(&kept.collect::<Vec<_>>().join("\n\n"))
}

/// Replaces links of rustdoc in the comments of messages by names.
fn without_links(text: &str) -> String {
    let mut parts = text.split("[`");
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |text, part| {
        let (path, rest) = part.split_once("`]").expect("the end of a link");
        let name = path.rsplit("::").next().unwrap_or_default();
        text + name + rest
    })
}

#[test]
fn the_header_is_generated_from_the_sources() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (path, expected) = (folder.join("include/emberwatch.h"), generated(folder));
    if std::env::var_os("WRITE_HEADER").is_some() {
        std::fs::write(&path, &expected).expect("write the header");
    }
    let got = std::fs::read_to_string(path).expect("the header");
    let differs = expected.lines().zip(got.lines()).find(|(a, b)| a != b);
    assert_eq!(differs, None, "WRITE_HEADER=1 cargo test -p emberwatch-c");
    assert_eq!(
        expected.len(),
        got.len(),
        "WRITE_HEADER=1 cargo test -p emberwatch-c"
    );
}
