//! One program: each would link candle.

mod prior;
mod report;
