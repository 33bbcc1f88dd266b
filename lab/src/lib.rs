//! Roomcast's laboratory: the paper's experiments and ours, with charts. The program `roomcast-lab` runs them.

pub mod experiment;
pub mod home_simulation;

/// The shipped activity programs for homes, by name, for tests.
#[cfg(test)]
const PROGRAMS: [(&str, &str); 3] = [
    ("p0-breakfast-and-television", include_str!("../../scenes/programs/p0-breakfast-and-television.txt")),
    ("p1-laundry-and-to-bed", include_str!("../../scenes/programs/p1-laundry-and-to-bed.txt")),
    ("p2-long-evening", include_str!("../../scenes/programs/p2-long-evening.txt")),
];
