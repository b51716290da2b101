//! Tests of reports on synthetic results: text, files and figures.

mod figures;
mod files;
mod synthetic;
mod text;
mod worlds;
