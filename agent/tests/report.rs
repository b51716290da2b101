//! Reports on synthetic results: their text, their files and their pictures.

mod figures;
mod files;
mod synthetic;
mod text;
mod worlds;
