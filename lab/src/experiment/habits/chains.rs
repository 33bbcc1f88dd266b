//! Baselines of habits, learned online: chains, Kneser-Ney with a cache, and prediction by partial matching.

use std::collections::{BTreeMap, HashMap, VecDeque};

pub(crate) const ORDER_MAX: usize = 3;
/// Observations that the shorter context of a chain is worth.
const CHAIN_STRENGTH: f64 = 2.0;
/// Absolute discount of Kneser-Ney smoothing.
const DISCOUNT: f64 = 0.75;
/// Weight of the cache, and how many symbols it holds.
const CACHE: f64 = 0.15;
const CACHED: usize = 30;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Style {
    /// A chain of this order: each context over the shorter one, with a strength.
    Markov(usize),
    /// Third-order interpolated Kneser-Ney.
    KneserNey,
    /// As [`Style::KneserNey`], with a cache of recent symbols.
    KneserNeyCache,
    /// Third-order prediction by partial matching with escapes by method C and exclusion, as Active LeZi and SPEED use it for homes.
    Ppm,
}

/// Counts of what followed contexts of up to three symbols.
#[derive(Debug, Clone)]
pub(crate) struct Chain {
    style: Style,
    counts: HashMap<Vec<u32>, BTreeMap<usize, f64>>,
    cache: VecDeque<usize>,
}

impl Chain {
    pub(crate) fn new(style: Style) -> Self {
        Self { style, counts: HashMap::new(), cache: VecDeque::new() }
    }

    fn order(&self) -> usize {
        match self.style {
            Style::Markov(order) => order,
            Style::KneserNey | Style::KneserNeyCache | Style::Ppm => ORDER_MAX,
        }
    }

    /// Another activity begins.
    pub(crate) fn forget_cache(&mut self) {
        self.cache.clear();
    }

    /// The probabilities of the next symbol, 0 to `symbols - 1`, after a context that starts with the latest symbol.
    pub(crate) fn predict(&self, context: &[u32], symbols: usize) -> Vec<f64> {
        let even = 1.0 / symbols.max(1) as f64;
        let orders = 0..=self.order().min(context.len());
        if self.style == Style::Ppm {
            return self.by_partial_matching(context, symbols);
        }
        let mut p = vec![even; symbols];
        for order in orders {
            let Some(counts) = self.counts.get(&context[..order]) else { continue };
            let total: f64 = counts.values().sum();
            let (discount, kept) = match self.style {
                Style::Markov(_) => (0.0, CHAIN_STRENGTH / (total + CHAIN_STRENGTH)),
                _ => (DISCOUNT, counts.values().map(|n| n.min(DISCOUNT)).sum::<f64>() / total),
            };
            let scale = if discount > 0.0 { 1.0 / total } else { (1.0 - kept) / total };
            p.iter_mut().for_each(|p| *p *= kept);
            counts.iter().for_each(|(symbol, n)| p[*symbol] += (n - n.min(discount)) * scale);
        }
        if self.style == Style::KneserNeyCache {
            // Every symbol has some probability.
            p.iter_mut().for_each(|p| *p = 0.999 * *p + 0.001 * even);
            if !self.cache.is_empty() {
                p.iter_mut().for_each(|p| *p *= 1.0 - CACHE);
                self.cache.iter().for_each(|symbol| p[*symbol] += CACHE / self.cache.len() as f64);
            }
        }
        p
    }

    fn by_partial_matching(&self, context: &[u32], symbols: usize) -> Vec<f64> {
        let mut p = vec![0.0; symbols];
        let mut excluded = vec![false; symbols];
        let mut left = 1.0;
        for order in (0..=self.order().min(context.len())).rev() {
            let Some(counts) = self.counts.get(&context[..order]) else { continue };
            let open = || counts.iter().filter(|(symbol, _)| !excluded[**symbol]);
            let (total, kinds) = (open().map(|(_, n)| n).sum::<f64>(), open().count() as f64);
            if kinds == 0.0 {
                continue;
            }
            let escape = kinds / (total + kinds);
            open().for_each(|(symbol, n)| p[*symbol] = left * n / (total + kinds));
            counts.keys().for_each(|symbol| excluded[*symbol] = true);
            left *= escape;
        }
        let open = excluded.iter().filter(|excluded| !**excluded).count();
        if open == 0 {
            let total: f64 = p.iter().sum();
            p.iter_mut().for_each(|p| *p /= total);
        } else {
            p.iter_mut().zip(&excluded).filter(|(_, excluded)| !**excluded).for_each(|(p, _)| *p = left / open as f64);
        }
        p
    }

    pub(crate) fn learn(&mut self, context: &[u32], symbol: usize) {
        for order in (0..=self.order().min(context.len())).rev() {
            let count = self.counts.entry(context[..order].to_vec()).or_default().entry(symbol).or_default();
            *count += 1.0;
            // Shorter contexts count only the symbols that were new in the longer ones.
            if !matches!(self.style, Style::Markov(_)) && *count > 1.0 {
                break;
            }
        }
        if self.style == Style::KneserNeyCache {
            self.cache.push_front(symbol);
            self.cache.truncate(CACHED);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_learns_what_follows_and_gives_probabilities() {
        for style in [Style::Markov(1), Style::Markov(2), Style::KneserNey, Style::KneserNeyCache, Style::Ppm] {
            let mut chain = Chain::new(style);
            let text: Vec<usize> = (0..60).map(|at| [0, 1, 2, 1][at % 4]).collect();
            let context = |at: usize| (1..=ORDER_MAX.min(at)).map(|back| text[at - back] as u32).collect::<Vec<_>>();
            for (at, next) in text.iter().enumerate() {
                let p = chain.predict(&context(at), 5);
                assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9 && p.iter().all(|p| *p > 0.0), "{style:?} {p:?}");
                chain.learn(&context(at), *next);
            }
            let p = chain.predict(&[1, 0], 5);
            let likeliest = (0..5).max_by(|a, b| p[*a].total_cmp(&p[*b])).unwrap();
            assert!(style == Style::Markov(1) || (likeliest == 2 && p[2] > 0.6), "{style:?} {p:?}");
            chain.forget_cache();
        }
    }
}
