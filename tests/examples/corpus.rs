//! Regenerates the generated files of `fuzz/corpus`. Run it after a format has changed.

fn main() -> std::io::Result<()> {
    let mut targets = tests::fuzz::TARGETS.iter();
    targets.try_for_each(tests::fuzz::Target::write_seeds)
}
