//! The bootstrap (Efron, 1979): the variation of a figure when the measurements are drawn again, with replacement.

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

/// Draws as many values as there are, with replacement.
pub(crate) fn drawn<T: Copy>(of: &[T], rng: &mut ChaCha8Rng) -> Vec<T> {
    of.iter().map(|_| of[rng.random_range(0..of.len())]).collect()
}

/// The middle 95 % of the values; `None` without values.
pub(crate) fn ci95(mut values: Vec<f64>) -> Option<[f64; 2]> {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values.get((share * values.len() as f64) as usize).copied();
    at(0.025).zip(at(0.975)).map(<[f64; 2]>::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;

    #[test]
    fn the_middle_lies_within() {
        assert_eq!(ci95((0..1000).rev().map(f64::from).collect()), Some([25.0, 975.0]));
        assert_eq!(ci95(vec![3.0]), Some([3.0, 3.0]));
        assert_eq!(ci95(Vec::new()), None);
    }

    #[test]
    fn draws_are_of_what_there_is() {
        let drawn = drawn(&[2, 4, 6, 8], &mut ChaCha8Rng::seed_from_u64(1));
        assert!(drawn.len() == 4 && drawn.iter().all(|value| [2, 4, 6, 8].contains(value)), "{drawn:?}");
    }
}
