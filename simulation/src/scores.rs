//! Label scores for experiments: the product's scorer with a cache on disk.
//!
//! A score depends on the model, the labels, the scoring options, and the prompt. The cache has a file per model, labels and scoring
//! options, and in it a record per prompt. Records have a checksum, so that a run can continue the cache of an interrupted one.

use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use roomcast_core::narration::history::{History, HistoryLimits};
use roomcast_core::narration::{Observation, Sentence};
use roomcast_core::prompt::{BindingSequence, write_prompt};
use roomcast_core::scorer::correction::{Correction, CorrectionChoice};
use roomcast_core::scorer::{
    LabelScores, LanguageModel, Method, ModelInfo, PreparedLabels, ScoreError, Scorer, TextStart, Tokenisation,
};

/// Label scores are not available.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScoresError {
    /// The scorer failed.
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// The cache failed.
    #[error(
        "failed to use the cache of scores {path}: {source}; choose another place with --cache, or none with --no-cache"
    )]
    Cache {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

type Key = [u8; 32];

#[derive(Debug)]
struct Cache {
    file: BufWriter<File>,
    path: PathBuf,
    scores: HashMap<Key, Vec<f64>>,
}

impl Cache {
    fn open(folder: &Path, name: &str, labels: usize) -> Result<Self, ScoresError> {
        let path = folder.join(format!("{name}.scores"));
        let failed = |source| ScoresError::Cache { path: path.clone(), source };
        std::fs::create_dir_all(folder).map_err(failed)?;
        let mut file =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).map_err(failed)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).map_err(failed)?;
        let mut scores = HashMap::new();
        let mut valid = 0;
        for record in bytes.chunks_exact(record_bytes(labels)) {
            let Some((key, values)) = read_record(record) else { break };
            scores.insert(key, values);
            valid += record.len() as u64;
        }
        // The bytes after the last complete record are from an interrupted run.
        file.set_len(valid).map_err(failed)?;
        std::io::Seek::seek(&mut file, std::io::SeekFrom::End(0)).map_err(failed)?;
        Ok(Self { file: BufWriter::new(file), path, scores })
    }

    fn insert(&mut self, key: Key, values: &[f64]) -> Result<(), ScoresError> {
        let mut record = Vec::with_capacity(record_bytes(values.len()));
        record.extend_from_slice(&key);
        values.iter().for_each(|value| record.extend_from_slice(&value.to_le_bytes()));
        let sum = checksum(&record);
        record.extend_from_slice(&sum);
        let written = self.file.write_all(&record);
        written.map_err(|source| ScoresError::Cache { path: self.path.clone(), source })?;
        self.scores.insert(key, values.to_vec());
        Ok(())
    }
}

const CHECKSUM_BYTES: usize = 8;

fn record_bytes(labels: usize) -> usize {
    size_of::<Key>() + labels * size_of::<f64>() + CHECKSUM_BYTES
}

fn checksum(bytes: &[u8]) -> [u8; CHECKSUM_BYTES] {
    let digest = Sha256::digest(bytes);
    std::array::from_fn(|i| digest[i])
}

fn read_record(record: &[u8]) -> Option<(Key, Vec<f64>)> {
    let (body, sum) = record.split_at_checked(record.len().checked_sub(CHECKSUM_BYTES)?)?;
    if checksum(body) != sum {
        return None;
    }
    let (key, values) = body.split_first_chunk::<32>()?;
    Some((*key, values.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect()))
}

/// Scores the labels of one map after any narration and binding sequence.
#[derive(Debug)]
pub struct ScoreSource<M> {
    scorer: Scorer<M>,
    labels: Vec<String>,
    prepared: HashMap<BindingSequence, PreparedLabels>,
    method: Method,
    tokenisation: Tokenisation,
    correction: Correction,
    cache: Option<Cache>,
    known: HashMap<Key, Vec<f64>>,
    prompt: String,
    out: LabelScores,
    computed: usize,
}

impl<M: LanguageModel> ScoreSource<M> {
    /// A source for `labels`, in their order. `cache` is the folder of the cache, if there is one.
    ///
    /// # Errors
    /// When the cache cannot be opened.
    pub fn new(
        model: M,
        labels: &[&str],
        method: Method,
        tokenisation: Tokenisation,
        correction: CorrectionChoice,
        cache: Option<&Path>,
    ) -> Result<Self, ScoresError> {
        let correction = correction.or(model.info().correction);
        let mut name = Sha256::new();
        name.update(model.info().fingerprint);
        name.update(format!("{method:?} {tokenisation:?} {correction:?}"));
        for label in labels {
            name.update((label.len() as u64).to_le_bytes());
            name.update(label);
        }
        let name: String = name.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect();
        let cache = cache.map(|folder| Cache::open(folder, &name, labels.len())).transpose()?;
        Ok(Self {
            scorer: Scorer::new(model),
            labels: labels.iter().map(|label| (*label).to_owned()).collect(),
            prepared: HashMap::new(),
            method,
            tokenisation,
            correction,
            cache,
            known: HashMap::new(),
            prompt: String::new(),
            out: LabelScores::default(),
            computed: 0,
        })
    }

    /// The model's description.
    pub fn model(&self) -> &ModelInfo {
        self.scorer.info()
    }

    /// The model.
    pub fn language_model(&self) -> &M {
        self.scorer.model()
    }

    /// The correction of the scores.
    #[must_use]
    pub fn correction(&self) -> Correction {
        self.correction
    }

    /// The number of scores that came from the model and not from the cache.
    #[must_use]
    pub fn computed(&self) -> usize {
        self.computed
    }

    /// ln s_c in nats for each label (Equation 1, corrected) after the sentences of a window and the binding sequence.
    ///
    /// # Errors
    /// When the model fails or the cache cannot be written.
    pub fn score<'a>(
        &mut self,
        sentences: impl IntoIterator<Item = &'a str>,
        binding: &BindingSequence,
    ) -> Result<Vec<f64>, ScoresError> {
        let paper = self.tokenisation == Tokenisation::Paper;
        write_prompt(sentences, binding, paper, &mut self.prompt);
        // The labels' tokens depend on the binding sequence at the end of the prompt.
        let key: Key = Sha256::digest(format!("{}\n{}", binding.text(), self.prompt)).into();
        let cached = self.cache.as_ref().map_or(&self.known, |cache| &cache.scores).get(&key);
        if let Some(scores) = cached {
            return Ok(scores.clone());
        }
        if !self.prepared.contains_key(binding) {
            let prepared = self.scorer.prepare(&self.labels, binding, self.tokenisation, self.correction)?;
            self.prepared.insert(binding.clone(), prepared);
        }
        self.scorer.score(&self.prepared[binding], &self.prompt, self.method, &mut self.out)?;
        self.computed += 1;
        let scores = self.out.log_prob_nats.clone();
        match &mut self.cache {
            Some(cache) => cache.insert(key, &scores)?,
            None => {
                self.known.insert(key, scores.clone());
            }
        }
        Ok(scores)
    }

    /// Scores after no sentence and after each of `sentences`, one by one, as the daemon computes them with these limits. There is one row
    /// more than sentences.
    ///
    /// # Errors
    /// As [`ScoreSource::score`].
    pub fn score_steps(
        &mut self,
        sentences: &[Sentence],
        limits: HistoryLimits,
        binding: &BindingSequence,
    ) -> Result<Vec<Vec<f64>>, ScoresError> {
        let mut history = History::new(limits);
        let mut tokens = Vec::new();
        let mut rows = vec![self.score([], binding)?];
        for sentence in sentences {
            tokens.clear();
            let cut = self.scorer.model().tokenise(sentence.as_str(), TextStart::Within, &mut tokens);
            cut.map_err(ScoreError::from)?;
            history.push(Observation::of(0, sentence.clone()), tokens.len() + 1);
            rows.push(self.score(history.sentences(), binding)?);
        }
        Ok(rows)
    }

    /// Writes the cached scores from memory.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn flush(&mut self) -> Result<(), ScoresError> {
        let Some(cache) = &mut self.cache else { return Ok(()) };
        cache.file.flush().map_err(|source| ScoresError::Cache { path: cache.path.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::scorer::table::TableModel;

    const LABELS: [&str; 3] = ["mug", "sofa", "washing machine"];

    fn source(folder: &Path) -> ScoreSource<TableModel> {
        ScoreSource::new(
            TableModel::new(3),
            &LABELS,
            Method::Trie,
            Tokenisation::Joint,
            CorrectionChoice::default(),
            Some(folder),
        )
        .unwrap()
    }

    #[test]
    fn a_second_run_needs_no_model_and_a_damaged_tail_is_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let sentences = ["They sit.", "They sleep.", "They eat."].map(|s| Sentence::new(s).unwrap());
        let binding = BindingSequence::default();
        let mut first = source(folder.path());
        let rows = first.score_steps(&sentences, HistoryLimits::exact(2), &binding).unwrap();
        assert_eq!((rows.len(), first.computed()), (4, 4));
        first.flush().unwrap();
        drop(first);

        let mut second = source(folder.path());
        assert_eq!(second.score_steps(&sentences, HistoryLimits::exact(2), &binding).unwrap(), rows);
        assert_eq!(second.computed(), 0);
        drop(second);

        let file = std::fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() - 5]).unwrap();
        let mut third = source(folder.path());
        assert_eq!(third.score_steps(&sentences, HistoryLimits::exact(2), &binding).unwrap(), rows);
        assert_eq!(third.computed(), 1);
    }
}
