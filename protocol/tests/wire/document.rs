//! Reads PROTOCOL.md: its tables, its fences and its worked example.

/// The document.
pub const PROTOCOL: &str = include_str!("../../../PROTOCOL.md");

/// A struct, from the code or from a byte table.
#[derive(Debug, PartialEq)]
pub struct Layout {
    pub name: &'static str,
    pub type_name: &'static str,
    pub size: usize,
    pub alignment: usize,
    pub fields: Vec<Field>,
}

/// A field, from the code or from a row of a byte table.
#[derive(Debug, PartialEq)]
pub struct Field {
    pub name: String,
    pub offset: usize,
    pub size: usize,
    pub of: String,
}

/// Returns the cells of each row of the only table whose header line begins with `header`.
pub fn rows_under(header: &str) -> Vec<Vec<String>> {
    let (_, rest) = PROTOCOL.split_once(&format!("\n{header}")).expect(header);
    assert!(!rest.contains(&format!("\n{header}")), "two {header}");
    rows(rest)
}

/// Returns the documented layout of a struct, and its documented Python `struct` format.
pub fn documented_struct(name: &'static str) -> (Layout, String) {
    let start = format!("\n### {name}: `");
    let (_, rest) = PROTOCOL.split_once(&start).expect(name);
    let (heading, table) = rest.split_once('\n').expect("a table follows");
    let parts: Vec<&'static str> = heading.split('`').collect();
    let numbers: Vec<usize> = parts[1]
        .split([' ', ','])
        .filter_map(|word| word.parse().ok())
        .collect();
    let (_, table) = table.split_once("| offset |").expect("a byte table");
    let layout = Layout {
        name,
        type_name: parts[0],
        size: numbers[0],
        alignment: numbers[1],
        fields: rows(table).into_iter().map(field).collect(),
    };
    (layout, parts[2].into())
}

/// Returns the fields in the only byte table whose header line begins with `header`.
pub fn fields_under(header: &str) -> Vec<Field> {
    rows_under(header).into_iter().map(field).collect()
}

fn field(row: Vec<String>) -> Field {
    Field {
        offset: row[0].parse().expect("an offset"),
        size: row[1].parse().expect("a size"),
        of: row[2].clone(),
        name: row[3].clone(),
    }
}

/// Returns the fenced blocks of a language. Each block is returned as the title after the language, and the text of the
/// block.
pub fn fences(language: &str) -> Vec<(&'static str, &'static str)> {
    let blocks = PROTOCOL.split("\n```").skip(1).step_by(2);
    blocks
        .filter_map(|block| block.strip_prefix(language)?.split_once('\n'))
        .collect()
}

/// Returns the codes of fields in Python's `struct`.
pub fn struct_codes(fields: &[Field]) -> String {
    let code = |field: &Field| match field.of.as_str() {
        "u16" => "H".into(),
        "u32" => "I".into(),
        "u64" => "Q".into(),
        "f64" => "d".into(),
        "WorldResult" => struct_codes(&documented_struct("WorldResult").0.fields),
        other => panic!("{other}: unknown type"),
    };
    fields.iter().map(code).collect()
}

/// Returns the bytes of a worked example. Checks the names of its fields, and that each value matches its bytes.
pub fn worked_example(name: &'static str) -> Vec<u8> {
    let mut blocks = fences("hex").into_iter();
    let (_, text) = blocks.find(|(title, _)| title.trim() == name).expect(name);
    let mut bytes = Vec::new();
    let mut names = Vec::new();
    for line in text.lines() {
        let (hex, fields) = line.split_once("  | ").expect("hex | fields");
        let (offset, hex) = hex.split_once("  ").expect("offset, hex");
        assert_eq!(usize::from_str_radix(offset, 16), Ok(bytes.len()), "{line}");
        let (groups, fields) = (hex.split("  "), fields.split(", "));
        assert_eq!(groups.clone().count(), fields.clone().count(), "{line}");
        for (group, field) in groups.map(bytes_of_hex).zip(fields) {
            let (name, value) = field.split_once(" = ").expect("name = value");
            assert_eq!(shown(name, &group), value, "{line}");
            names.push(name);
            bytes.extend(group);
        }
    }
    let structs = match name {
        "StepReply" => vec!["StepReply", "WorldResult", "RobotResult", "RobotResult"],
        other => vec![other],
    };
    let fields = structs
        .into_iter()
        .flat_map(|name| documented_struct(name).0.fields);
    let fields: Vec<String> = fields.map(|field| field.name).collect();
    assert_eq!(names[..fields.len()], fields, "fields of {name}");
    bytes
}

/// Returns a field's value as the worked example writes it.
fn shown(name: &str, bytes: &[u8]) -> String {
    let words = |word: fn(u8) -> String| {
        let words: Vec<String> = bytes.iter().map(|byte| word(*byte)).collect();
        words.join(" ")
    };
    if name.starts_with("path") {
        return words(|byte| ["up", "down", "left", "right"][usize::from(byte)].into());
    }
    if name.starts_with("frame") {
        return words(|byte| {
            if byte == 255 {
                "-".into()
            } else {
                byte.to_string()
            }
        });
    }
    let mut wide = [0; 8];
    wide[..bytes.len()].copy_from_slice(bytes);
    match name {
        "reward" | "marginal" => f64::from_le_bytes(wide).to_string(),
        _ => u64::from_le_bytes(wide).to_string(),
    }
}

fn bytes_of_hex(text: &str) -> Vec<u8> {
    let byte = |word| u8::from_str_radix(word, 16).expect("hexadecimal");
    text.split(' ').map(byte).collect()
}

/// Returns the rows of a table. `rest` is the rest of the document, beginning inside the header line of the table.
fn rows(rest: &str) -> Vec<Vec<String>> {
    let lines = rest.lines().skip(2);
    let cells = |line: &str| {
        let cells = line.trim_matches('|').split('|');
        cells.map(|cell| cell.trim().to_owned()).collect()
    };
    lines
        .take_while(|line| line.starts_with('|'))
        .map(cells)
        .collect()
}
