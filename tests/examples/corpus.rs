//! Regenerates the generated files of `fuzz/corpus`. Needed after a change of a format.

fn main() -> std::io::Result<()> {
    let mut targets = tests::fuzz::TARGETS.iter();
    targets.try_for_each(tests::fuzz::Target::write_seeds)
}
