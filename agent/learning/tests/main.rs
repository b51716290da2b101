//! One program: each would link candle.

mod learned_filter;
mod own_kernels;
mod rollout;
