//! All tests in one program, because each test program would link candle separately.

mod report;
