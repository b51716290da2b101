//! Hostile bytes for every decoder, on stable Rust:
//!
//!     cargo run --release -p tests --example fuzz -- --messages 10000000 --files 1000000
//!
//! A table of what each decoder did; an input that panics, hangs or grows is named, saved, and ends it.

use anyhow::{Context, Result, bail};
use std::io::{Write, stdout};
use tests::fuzz::campaign::Campaign;
use tests::fuzz::{Kind, TARGETS, Target, named};

/// What to run.
struct Plan {
    messages: u64,
    files: u64,
    seed: u64,
    target: Option<&'static Target>,
}

fn main() -> Result<()> {
    let mut plan = Plan {
        messages: 100_000,
        files: 10_000,
        seed: 1,
        target: None,
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(flag) = arguments.next() {
        if flag == "--seeds" {
            return Ok(TARGETS.iter().try_for_each(Target::write_seeds)?);
        }
        let value = arguments
            .next()
            .with_context(|| format!("{flag}: expected a value"))?;
        let number = || {
            value
                .parse()
                .with_context(|| format!("{flag}: expected a number, got {value}"))
        };
        match &*flag {
            "--messages" => plan.messages = number()?,
            "--files" => plan.files = number()?,
            "--seed" => plan.seed = number()?,
            "--target" => {
                let target = named(&value);
                plan.target = Some(target.with_context(|| format!("no target {value:?}"))?);
            }
            _ => bail!("expected --messages, --files, --seed, --target or --seeds, got {flag}"),
        }
    }
    run(&plan)
}

/// Shares the numbers among the targets of each kind.
fn run(plan: &Plan) -> Result<()> {
    let mut out = stdout().lock();
    writeln!(
        out,
        "{:16}{:>10}{:>10}{:>10}{:>20}",
        "", "inputs", "accepted", "a second", "resident, MiB"
    )?;
    let is_chosen = |target: &&Target| plan.target.is_none_or(|chosen| chosen.name == target.name);
    let chosen: Vec<&Target> = TARGETS.iter().filter(is_chosen).collect();
    for target in &chosen {
        let n_alike = chosen
            .iter()
            .filter(|other| other.kind == target.kind)
            .count() as u64;
        let n_inputs = match target.kind {
            Kind::Message => plan.messages,
            Kind::File => plan.files,
        };
        let n_inputs = n_inputs.div_ceil(n_alike);
        let report = Campaign::new(**target, plan.seed)?.run(n_inputs)?;
        let mebibytes = |kibibytes: u64| kibibytes as f64 / 1024.0;
        writeln!(
            out,
            "{:16}{n_inputs:>10}{:>9.1}%{:>10.0}{:>11.1} -> {:.1}",
            target.name,
            report.n_accepted as f64 * 100.0 / n_inputs as f64,
            n_inputs as f64 / report.elapsed.as_secs_f64(),
            mebibytes(report.resident_before),
            mebibytes(report.resident_after),
        )?;
    }
    Ok(())
}
