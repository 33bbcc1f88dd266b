//! The labels' tokens as a trie, flat and in preorder, built once per map, model and binding sequence.
//!
//! A label that ends at node `n` has the score `q(n)`, the product of the token probabilities from the prompt to `n`. In a trie of all tokens
//! ([`LabelTrie::new`]) this is Equation 1; in a trie of the distinguishing tokens (`LabelTrie::distinct_prefixes`) it is a corrected score.
//! Children's probabilities come from the logits of their parent, so only *inner* nodes (those with children) are decoded. A label's last token never
//! is, and a label of one token costs nothing beyond the prompt.

/// A token of a model's vocabulary.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize)]
#[serde(transparent)]
pub struct Token(pub i32);

/// No parent: the node follows the prompt directly.
pub const PROMPT: u32 = u32::MAX;

/// Follows the last token of a label that begins another one, in [`LabelTrie::distinct_prefixes`]: the label ends here. It is not in any vocabulary,
/// and always a leaf.
pub(crate) const END: Token = Token(-1);

/// One node of the trie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Node {
    /// The token that leads here.
    pub token: Token,
    /// Index of the parent, or [`PROMPT`].
    pub parent: u32,
    /// Tokens from the prompt to here; 1 for the first.
    pub depth: u32,
    /// Nodes in the subtree, this one included: the next node outside it is at `index + subtree`.
    pub subtree: u32,
    /// Index among the inner nodes, or [`PROMPT`] for a leaf.
    pub inner: u32,
}

/// The flat preorder trie of all labels.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LabelTrie {
    nodes: Vec<Node>,
    /// Per label: the node at which it ends.
    label_end: Vec<u32>,
    /// Node index of each inner node, in preorder.
    inner: Vec<u32>,
}

impl LabelTrie {
    /// Builds the trie from each label's tokens; label `i` of the result is `labels[i]`.
    ///
    /// Token sequences must not be empty; [`crate::scorer::Scorer::prepare`] refuses them.
    #[must_use]
    pub fn new<L: AsRef<[Token]>>(labels: &[L]) -> Self {
        let mut order: Vec<usize> = (0..labels.len()).collect();
        order.sort_by(|&a, &b| labels[a].as_ref().cmp(labels[b].as_ref()));
        let mut trie = Self { label_end: vec![PROMPT; labels.len()], ..Self::default() };
        let mut path: Vec<u32> = Vec::new();
        for label in order {
            let tokens = labels[label].as_ref();
            let shared =
                path.iter().zip(tokens).take_while(|&(&node, &token)| trie.nodes[node as usize].token == token).count();
            path.truncate(shared);
            for &token in &tokens[shared..] {
                let index = trie.nodes.len() as u32;
                let parent = path.last().copied().unwrap_or(PROMPT);
                trie.nodes.push(Node { token, parent, depth: path.len() as u32 + 1, subtree: 1, inner: PROMPT });
                path.push(index);
            }
            if let Some(&end) = path.last() {
                trie.label_end[label] = end;
            }
        }
        trie.complete();
        trie
    }

    /// The trie of distinguishing prefixes: a label ends where it differs from all others, and a label that begins another has the child `END`.
    /// Labels with equal tokens keep all tokens.
    #[must_use]
    pub(crate) fn distinct_prefixes<L: AsRef<[Token]>>(labels: &[L]) -> Self {
        let whole = Self::new(labels);
        let ended: Vec<Vec<Token>> = (labels.iter().zip(&whole.label_end))
            .map(|(label, &end)| {
                let begins_another = whole.nodes.get(end as usize).is_some_and(|node| node.subtree > 1);
                label.as_ref().iter().copied().chain(begins_another.then_some(END)).collect()
            })
            .collect();
        let whole = Self::new(&ended);
        let mut through = vec![0_u32; whole.nodes.len()];
        for label in 0..ended.len() {
            whole.path(label).for_each(|node| through[node] += 1);
        }
        let shortest: Vec<&[Token]> = (ended.iter().enumerate())
            .map(|(label, tokens)| {
                let alone = whole.path(label).filter(|&node| through[node] == 1).count();
                &tokens[..tokens.len() - alone.saturating_sub(1)]
            })
            .collect();
        Self::new(&shortest)
    }

    /// The nodes from a label's end back to its first token.
    pub fn path(&self, label: usize) -> impl Iterator<Item = usize> {
        let known = |node: u32| (node != PROMPT).then_some(node as usize);
        let end = self.label_end.get(label).and_then(|&end| known(end));
        std::iter::successors(end, move |&node| known(self.nodes[node].parent))
    }

    /// The children of a node, or the first nodes after the prompt for `None`.
    pub fn children(&self, parent: Option<usize>) -> impl Iterator<Item = usize> + Clone {
        let (first, end) = match parent {
            None => (0, self.nodes.len()),
            Some(parent) => (parent + 1, parent + self.nodes[parent].subtree as usize),
        };
        let inside = move |node: usize| (node < end).then_some(node);
        std::iter::successors(inside(first), move |&node| inside(node + self.nodes[node].subtree as usize))
    }

    /// The same labels without sharing: one chain per label, in the labels' order.
    #[must_use]
    pub fn chains<L: AsRef<[Token]>>(labels: &[L]) -> Self {
        let mut trie = Self::default();
        for label in labels {
            let mut parent = PROMPT;
            for (depth, &token) in (1..).zip(label.as_ref()) {
                let index = trie.nodes.len() as u32;
                trie.nodes.push(Node { token, parent, depth, subtree: 1, inner: PROMPT });
                parent = index;
            }
            trie.label_end.push(parent);
        }
        trie.complete();
        trie
    }

    /// Fills in subtree sizes and inner nodes; all nodes must be in preorder.
    fn complete(&mut self) {
        let trie = self;
        for index in (0..trie.nodes.len()).rev() {
            let Node { parent, subtree, .. } = trie.nodes[index];
            if parent != PROMPT {
                trie.nodes[parent as usize].subtree += subtree;
            }
        }
        for index in 0..trie.nodes.len() {
            if trie.nodes[index].subtree > 1 {
                trie.nodes[index].inner = trie.inner.len() as u32;
                trie.inner.push(index as u32);
            }
        }
    }

    /// All nodes, in preorder.
    #[must_use]
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Indices of the nodes with children, in preorder: the nodes to decode.
    #[must_use]
    pub fn inner(&self) -> &[u32] {
        &self.inner
    }

    /// Per label the index of the node at which it ends.
    #[must_use]
    pub fn label_end(&self) -> &[u32] {
        &self.label_end
    }

    /// The trie as an indented drawing, one node per line.
    #[cfg(test)]
    fn draw(&self, mut token_text: impl FnMut(Token) -> String, labels: &[&str]) -> String {
        let mut out = String::new();
        for (index, node) in self.nodes.iter().enumerate() {
            out.push_str(&"  ".repeat(node.depth as usize - 1));
            out.push_str(&token_text(node.token));
            for (label, _) in self.label_end.iter().enumerate().filter(|&(_, &end)| end as usize == index) {
                out.push_str(&format!(" = {}", labels.get(label).copied().unwrap_or("?")));
            }
            out.push('\n');
        }
        out
    }
}

/// A tree of tokens to decode after the prompt, in preorder, with the paths that llama.cpp needs as sequences.
///
/// A *path* runs from the prompt to a node without children; a node lies on a contiguous range of paths.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TokenTree {
    tokens: Vec<Token>,
    parents: Vec<u32>,
    depths: Vec<u32>,
    /// First path through each node, and one past the last.
    paths: Vec<(u32, u32)>,
    path_count: u32,
}

impl TokenTree {
    /// The tree of all inner nodes of a trie, for [`Method::Trie`](crate::scorer::Method::Trie).
    #[must_use]
    pub fn of_inner_nodes(trie: &LabelTrie) -> Self {
        let mut tree = Self::default();
        for &index in trie.inner() {
            let node = trie.nodes()[index as usize];
            let parent = match node.parent {
                PROMPT => PROMPT,
                parent => trie.nodes()[parent as usize].inner,
            };
            tree.push(node.token, parent);
        }
        tree.finish();
        tree
    }

    /// Empties the tree and keeps its memory.
    pub fn clear(&mut self) {
        self.tokens.clear();
        self.parents.clear();
        self.depths.clear();
        self.paths.clear();
        self.path_count = 0;
    }

    /// Appends a node in preorder and returns its index; `parent` is an earlier index or [`PROMPT`].
    ///
    /// # Panics
    /// If `parent` is neither.
    pub fn push(&mut self, token: Token, parent: u32) -> u32 {
        let index = self.tokens.len() as u32;
        debug_assert!(parent == PROMPT || parent < index, "a parent stands before its children");
        let depth = if parent == PROMPT { 1 } else { self.depths[parent as usize] + 1 };
        self.tokens.push(token);
        self.parents.push(parent);
        self.depths.push(depth);
        self.paths.push((0, 0));
        index
    }

    /// Computes the paths; call it after the last [`TokenTree::push`].
    pub fn finish(&mut self) {
        let count = self.tokens.len();
        self.path_count = 0;
        for index in 0..count {
            // In preorder the first child directly follows its parent.
            let has_child = self.parents.get(index + 1) == Some(&(index as u32));
            let first = self.path_count;
            if !has_child {
                self.path_count += 1;
            }
            self.paths[index] = (first, first + 1);
        }
        for index in (0..count).rev() {
            let parent = self.parents[index];
            if parent != PROMPT {
                let last = self.paths[index].1;
                let range = &mut self.paths[parent as usize];
                range.1 = range.1.max(last);
            }
        }
    }

    /// Number of nodes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.tokens.len()
    }

    /// Whether the tree has no nodes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.tokens.is_empty()
    }

    /// Token of node `index`.
    #[must_use]
    pub fn token(&self, index: usize) -> Token {
        self.tokens[index]
    }

    /// Parent of node `index`, or [`PROMPT`].
    #[must_use]
    pub fn parent(&self, index: usize) -> u32 {
        self.parents[index]
    }

    /// Tokens from the prompt to node `index`, itself included.
    #[must_use]
    pub fn depth(&self, index: usize) -> u32 {
        self.depths[index]
    }

    /// The paths through node `index`: first, and one past the last.
    #[must_use]
    pub fn paths(&self, index: usize) -> (u32, u32) {
        self.paths[index]
    }

    /// Number of paths: sequences that a decoder needs at once.
    #[must_use]
    pub fn path_count(&self) -> u32 {
        self.path_count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens(text: &str) -> Vec<Token> {
        text.split(' ').map(|word| Token(word.bytes().map(i32::from).sum())).collect()
    }

    fn trie(labels: &[&str]) -> (LabelTrie, String) {
        let split: Vec<_> = labels.iter().map(|l| tokens(l)).collect();
        let words: Vec<&str> = labels.iter().flat_map(|l| l.split(' ')).collect();
        let trie = LabelTrie::new(&split);
        let drawn = trie
            .draw(|t| words.iter().find(|w| tokens(w)[0] == t).map_or_else(|| "?".into(), ToString::to_string), labels);
        (trie, drawn)
    }

    #[test]
    fn drawn_by_hand() {
        let (trie, drawn) = trie(&["coffee maker", "coffee", "book", "book shelf", "coffee table lamp"]);
        assert_eq!(
            drawn,
            "book = book\n  shelf = book shelf\ncoffee = coffee\n  table\n    lamp = coffee table lamp\n  maker = coffee maker\n"
        );
        assert_eq!(trie.inner(), [0, 2, 3]);
        assert_eq!(trie.nodes()[2].subtree, 4);
    }

    #[test]
    fn paths_are_contiguous_and_cover_the_tree() {
        let mut tree = TokenTree::default();
        let a = tree.push(Token(1), PROMPT);
        let b = tree.push(Token(2), a);
        tree.push(Token(3), b);
        tree.push(Token(4), a);
        tree.push(Token(5), PROMPT);
        tree.finish();
        let paths: Vec<_> = (0..tree.len()).map(|i| tree.paths(i)).collect();
        assert_eq!(paths, [(0, 2), (0, 1), (0, 1), (1, 2), (2, 3)]);
        assert_eq!(tree.path_count(), 3);
    }

    #[test]
    fn one_token_labels_need_no_decoding() {
        let (trie, _) = trie(&["mug", "cup", "bed"]);
        assert!(trie.inner().is_empty());
        assert!(TokenTree::of_inner_nodes(&trie).is_empty());
    }

    #[test]
    fn told_apart_by_hand() {
        let labels = ["coffee maker", "coffee", "book shelf", "coffee table lamp", "coffee table leg"];
        let split: Vec<_> = labels.iter().map(|label| tokens(label)).collect();
        let names = ["coffee", "maker", "book", "shelf", "table", "lamp", "leg"];
        let name =
            |token| names.iter().find(|name| tokens(name)[0] == token).map_or_else(|| ".".into(), ToString::to_string);
        assert_eq!(
            LabelTrie::distinct_prefixes(&split).draw(name, &labels),
            "book = book shelf\ncoffee\n  . = coffee\n  table\n    leg = coffee table leg\n    lamp = coffee table lamp\n  maker = coffee maker\n"
        );
        let twice = LabelTrie::distinct_prefixes(&[tokens("a b"), tokens("a b")]);
        assert_eq!((twice.nodes().len(), twice.label_end()), (2, &[1, 1][..]));
    }

    proptest::proptest! {
        /// Every label has its own leaf unless another label has the same tokens, and only distinguishing tokens remain.
        #[test]
        fn leaves_tell_labels_apart(labels in proptest::collection::hash_set(proptest::collection::vec(0..3i32, 1..5), 1..40)) {
            let labels: Vec<Vec<Token>> = labels.into_iter().map(|l| l.into_iter().map(Token).collect()).collect();
            let trie = LabelTrie::distinct_prefixes(&labels);
            let ends: std::collections::HashSet<_> = trie.label_end().iter().collect();
            proptest::prop_assert_eq!(ends.len(), labels.len());
            proptest::prop_assert!(trie.label_end().iter().all(|&end| trie.nodes()[end as usize].subtree == 1));
            for (label, tokens) in labels.iter().enumerate() {
                let mut path: Vec<_> = trie.path(label).map(|node| trie.nodes()[node].token).collect();
                path.reverse();
                let path = path.strip_suffix(&[END]).unwrap_or(&path);
                proptest::prop_assert!(tokens.starts_with(path));
                let end = trie.label_end()[label] as usize;
                let parent = trie.nodes()[end].parent;
                if parent != PROMPT {
                    let below = (0..labels.len()).filter(|&other| trie.path(other).any(|node| node == parent as usize));
                    proptest::prop_assert!(below.count() > 1, "a path that no other label shares is cut");
                }
            }
        }

        #[test]
        fn every_label_is_spelt_by_its_path(labels in proptest::collection::vec(proptest::collection::vec(0..4i32, 1..5), 1..40)) {
            let labels: Vec<Vec<Token>> = labels.into_iter().map(|l| l.into_iter().map(Token).collect()).collect();
            let trie = LabelTrie::new(&labels);
            for (label, &end) in labels.iter().zip(trie.label_end()) {
                let mut spelt = Vec::new();
                let mut node = end;
                while node != PROMPT {
                    spelt.push(trie.nodes()[node as usize].token);
                    node = trie.nodes()[node as usize].parent;
                }
                spelt.reverse();
                proptest::prop_assert_eq!(&spelt, label);
            }
            for (index, node) in trie.nodes().iter().enumerate() {
                let has_child = trie.nodes().iter().any(|n| n.parent == index as u32);
                proptest::prop_assert_eq!(node.inner != PROMPT, has_child);
            }
            let tree = TokenTree::of_inner_nodes(&trie);
            for path in 0..tree.path_count() {
                proptest::prop_assert!((0..tree.len()).any(|i| tree.paths(i) == (path, path + 1)));
            }
        }
    }
}
