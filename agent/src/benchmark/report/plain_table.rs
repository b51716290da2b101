//! What tables of a comparison look like.

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};

/// A Markdown table; all but the columns of names are right-aligned.
pub(super) fn plain_table(header: &[&str]) -> Table {
    let mut table = Table::new();
    table
        .load_preset(presets::ASCII_MARKDOWN)
        .set_content_arrangement(ContentArrangement::Disabled)
        .set_header(header);
    let numbers = table.column_iter_mut().zip(header);
    for (column, _) in numbers.filter(|(_, name)| !["policy", "estimator", "team"].contains(name)) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
