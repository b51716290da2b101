//! All integration tests in one program, because linking candle takes a long time.

mod learned_filter;
