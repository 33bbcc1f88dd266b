//! llama.cpp with the shipped model.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod cutter;
mod reading;
