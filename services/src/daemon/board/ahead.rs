//! Answers prepared while nobody waits: guesses at what each person does next, and their scores ([`Pipeline::prepare_answer`]).
//!
//! Nothing here is part of a step: what was said is read from the histories afterwards, so an event pays for a look at the answers and
//! nothing else.

use std::collections::BTreeMap;

use roomcast_core::guess::{Counts, Guesser, Thread};
use roomcast_core::narration::Sentence;
use roomcast_core::pipeline::{Pipeline, PipelineError};
use roomcast_core::scorer::LanguageModel;
use roomcast_ipc::score_flags;

use super::Board;

/// Of so many sentences it counts who did them, to say who does the next.
const ACTORS: usize = 16;

/// What was prepared since the start, for the status.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PreparedTally {
    /// Prompts that steps asked about.
    pub asked: u64,
    /// Answers that were prepared.
    pub prepared: u64,
    /// Prepared answers that a step used.
    pub used: u64,
}

/// Of one person.
#[derive(Debug, Default)]
struct Own {
    thread: Thread,
    /// How many sentences of their history were heard.
    heard: u64,
}

/// What is scored ahead.
#[derive(Debug)]
pub(super) struct Ahead {
    counts: Counts,
    guesser: Guesser,
    /// How many answers, of all persons together.
    most: usize,
    persons: BTreeMap<u32, Own>,
    /// Who did the last sentences.
    actors: Vec<u32>,
    /// In reverse.
    waiting: Vec<(u32, Sentence)>,
    /// The scores that these follow.
    planned: u64,
    prepared: u64,
}

impl Ahead {
    fn new<M: LanguageModel>(counts: Counts, most: usize, pipeline: &Pipeline<M>) -> Self {
        let guesser = Guesser::new(&counts, &pipeline.grounding().label_texts());
        let (persons, actors, waiting) = Default::default();
        Self { counts, guesser, most, persons, actors, waiting, planned: 0, prepared: 0 }
    }

    /// Learns what was said since the last time, and chooses what to score next.
    fn plan<M: LanguageModel>(&mut self, pipeline: &mut Pipeline<M>) {
        self.waiting.clear();
        self.persons.retain(|person, _| pipeline.histories().get(*person).is_some());
        let mut guesses: Vec<(u32, String, f64)> = Vec::new();
        for (person, history) in pipeline.histories().iter() {
            let own = self.persons.entry(person).or_default();
            let told = history.left() + history.len() as u64;
            let new = usize::try_from(told.saturating_sub(own.heard)).unwrap_or(usize::MAX);
            if new > history.len() {
                // What lies between is not known: these came after something else.
                own.thread = Thread::default();
            }
            let new = new.min(history.len());
            for sentence in history.sentences().skip(history.len() - new) {
                self.guesser.hear(&mut own.thread, sentence);
                self.actors.push(person);
            }
            own.heard = told;
            if history.is_empty() {
                // What came before a gap does not say what comes after it.
                own.thread = Thread::default();
            }
        }
        self.actors.drain(..self.actors.len().saturating_sub(ACTORS));
        for scores in pipeline.persons().filter(|scores| scores.at_home && scores.is_current) {
            let Some(own) = self.persons.get(&scores.person) else { continue };
            let own = self.guesser.guess(&own.thread, scores.label_log_prob_nats, self.most);
            let whole: f64 = own.iter().map(|(_, chance)| chance).sum();
            let acts = 1 + self.actors.iter().filter(|actor| **actor == scores.person).count();
            let chance = acts as f64 / whole.max(f64::MIN_POSITIVE);
            guesses.extend(own.into_iter().map(|(sentence, own)| (scores.person, sentence, own * chance)));
        }
        guesses.sort_by(|a, b| b.2.total_cmp(&a.2));
        guesses.truncate(self.most);
        // The model keeps one window read: each person's answers in a row, and last of whoever acted last, who is the likeliest to go on.
        let last = self.actors.last().copied();
        guesses.sort_by_key(|(person, ..)| (Some(*person) == last, *person));
        let sentence = |(person, text, _): (u32, String, f64)| Some((person, Sentence::new(&text).ok()?));
        self.waiting.extend(guesses.into_iter().rev().filter_map(sentence));
        let persons: Vec<u32> = self.persons.keys().copied().collect();
        persons.into_iter().for_each(|person| pipeline.drop_answers(person));
    }
}

impl<M: LanguageModel> Board<M> {
    /// The same, scoring up to `most` guesses at what is narrated next while nobody waits.
    #[must_use]
    pub fn with_prepared(mut self, counts: Counts, most: usize) -> Self {
        self.ahead = (most > 0).then(|| Box::new(Ahead::new(counts, most, &self.pipeline)));
        self
    }

    /// Whether there is something to prepare.
    pub(crate) fn is_preparing(&self) -> bool {
        let Some(ahead) = &self.ahead else { return false };
        self.is_scored() && (ahead.planned != self.snapshot.sequence || !ahead.waiting.is_empty())
    }

    /// One small step of preparation: a plan, or one answer. Gives whether there is more to do.
    ///
    /// # Errors
    /// When the model fails: no answer is prepared until the next scores.
    pub fn prepare(&mut self) -> Result<bool, PipelineError> {
        if !self.is_preparing() {
            return Ok(false);
        }
        let Some(ahead) = &mut self.ahead else { return Ok(false) };
        if ahead.planned != self.snapshot.sequence {
            if ahead.guesser.is_full() {
                self.forget_ahead();
            }
            let Some(ahead) = &mut self.ahead else { return Ok(false) };
            ahead.planned = self.snapshot.sequence;
            ahead.plan(&mut self.pipeline);
            return Ok(!ahead.waiting.is_empty());
        }
        while let Some((person, sentence)) = self.ahead.as_mut().and_then(|ahead| ahead.waiting.pop()) {
            if self.prepare_answer(person, &sentence)? {
                break;
            }
        }
        Ok(self.is_preparing())
    }

    /// Scores what a person may do next. Gives whether there was anything to score.
    ///
    /// # Errors
    /// When the model fails: nothing more is prepared until the next scores.
    pub fn prepare_answer(&mut self, person: u32, sentence: &Sentence) -> Result<bool, PipelineError> {
        let answered = self.pipeline.prepare_answer(person, sentence);
        if let Some(ahead) = &mut self.ahead {
            match &answered {
                Ok(is_new) => ahead.prepared += u64::from(*is_new),
                Err(_) => ahead.waiting.clear(),
            }
        }
        answered
    }

    /// What was prepared since the start.
    #[must_use]
    pub fn prepared(&self) -> PreparedTally {
        let prepared = self.ahead.as_ref().map_or(0, |ahead| ahead.prepared);
        PreparedTally { prepared, ..self.prepared }
    }

    /// After a step: what it asked, and what was ready.
    pub(super) fn count_prepared(&mut self) {
        let scores = self.pipeline.scores();
        self.prepared.asked += scores.asked as u64;
        self.prepared.used += scores.prepared as u64;
        if scores.prepared > 0 && scores.prepared == scores.asked {
            self.snapshot.flags |= score_flags::PREPARED;
        }
    }

    /// The map in use has other labels.
    pub(super) fn relabel_ahead(&mut self) {
        let Some(ahead) = &mut self.ahead else { return };
        ahead.guesser.set_labels(&self.pipeline.grounding().label_texts());
        ahead.waiting.clear();
    }

    /// Begins again with the training programs: somebody is forgotten, whose sentences it holds, or it can learn no more.
    pub(in crate::daemon) fn forget_ahead(&mut self) {
        let Some(ahead) = &mut self.ahead else { return };
        **ahead = Ahead {
            prepared: ahead.prepared,
            ..Ahead::new(std::mem::take(&mut ahead.counts), ahead.most, &self.pipeline)
        };
    }
}
