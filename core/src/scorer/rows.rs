//! Rows of logits: a check that all came, and the probabilities of a trie's nodes.

use super::{ModelError, softmax};
use crate::label_trie::{END, LabelTrie, Token};

/// The rows of logits that a call of [`super::LanguageModel::decode`] must visit, and the visited ones. A model of another author may miss one.
#[derive(Debug, Default)]
pub(super) struct Rows {
    /// Row 0 follows the prompt.
    came: Vec<bool>,
    given: usize,
    /// A row came that was not asked for.
    is_beyond: bool,
}

impl Rows {
    pub(super) fn ask(&mut self, nodes: usize, with_prompt: bool) {
        self.came.clear();
        self.came.resize(1 + nodes, false);
        self.came[0] = !with_prompt;
        (self.given, self.is_beyond) = (usize::from(!with_prompt), false);
    }

    /// Records a row, and returns whether it was asked for.
    pub(super) fn take(&mut self, row: usize) -> bool {
        let Some(came) = self.came.get_mut(row) else {
            self.is_beyond = true;
            return false;
        };
        self.given += usize::from(!std::mem::replace(came, true));
        true
    }

    /// Fails unless exactly the rows asked for came and all are finite.
    pub(super) fn check(&self, bad_row: Option<usize>) -> Result<(), ModelError> {
        let asked = self.came.len();
        match bad_row {
            Some(row) => Err(ModelError::NotFinite { at: row_name(row) }),
            None if self.given < asked || self.is_beyond => Err(ModelError::Rows { given: self.given, asked }),
            None => Ok(()),
        }
    }
}

/// Calls `give` with `ln p(child | path)` for every child of `parent` (the trie's roots for `None`), from the row of logits after `parent`.
///
/// `rivals` are the node's children in the trie of all labels. With them, only the children share the probability; if a label ends at the node, it
/// competes too, with the probability of all other tokens (`without_children` is scratch for this).
///
/// Returns false if a value that was needed is not finite. Minus infinity counts as a probability of zero.
pub(super) fn read_row(
    trie: &LabelTrie,
    parent: Option<usize>,
    rivals: Option<impl Iterator<Item = Token> + Clone>,
    logits: &[f32],
    without_children: &mut Vec<f32>,
    mut give: impl FnMut(usize, f64),
) -> bool {
    let place = |token: Token| usize::try_from(token.0).ok().filter(|&place| place < logits.len());
    let mut end = f64::NEG_INFINITY;
    let mut impossible = None;
    let denominator = match rivals {
        None => softmax::log_sum_exp(logits),
        Some(mut rivals) => {
            let children = rivals.clone().filter_map(place);
            let shared = softmax::log_sum_exp_of(children.clone().map(|place| f64::from(logits[place])));
            if rivals.any(|token| token == END) {
                without_children.clear();
                without_children.extend_from_slice(logits);
                children.for_each(|place| without_children[place] = f32::NEG_INFINITY);
                end = softmax::log_sum_exp(without_children);
                softmax::log_sum_exp_of([shared, end].into_iter())
            } else if shared == f64::NEG_INFINITY {
                // No label is possible here: the children are equally likely.
                impossible = Some(-(children.count() as f64).ln());
                0.0
            } else {
                shared
            }
        }
    };
    end -= denominator;
    for child in trie.children(parent) {
        let token = trie.nodes()[child].token;
        let logit = place(token).map_or(f64::NEG_INFINITY, |place| f64::from(logits[place]));
        give(child, if token == END { end } else { impossible.unwrap_or(logit - denominator) });
    }
    denominator.is_finite()
}

fn row_name(row: usize) -> String {
    if row == 0 { "the prompt".to_owned() } else { format!("trie node {}", row - 1) }
}
