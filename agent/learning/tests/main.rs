//! All integration tests in one program, because linking candle takes long.

mod learned_filter;
mod own_kernels;
mod rollout;
