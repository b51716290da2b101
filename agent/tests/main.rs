//! One program: each would link candle.

mod golden;
mod learned_filter;
mod own_kernels;
mod planning;
mod prior;
mod report;
mod rollout;
