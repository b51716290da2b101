//! Reports on synthetic results: their text, their files and their pictures.

mod figures;
mod synthetic;
mod text;
