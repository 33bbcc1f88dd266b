//! Roomcast.
fn main() {}
