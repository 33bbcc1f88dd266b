//! One step of the flow: observations in, scores of labels, items and partitions out.
//!
//! Every person is scored and grounded by themselves, as if they were alone. The scores of all together say for each partition
//! that somebody is there next: `1 - prod over persons (1 - p)`, which is `p` for one person.
//!
//! Whoever is out of the house is in no partition: their probabilities are 0, and the others' scores are as if those others were alone. What
//! they did before they left does not say what they do when they are back.
//!
//! Where many persons' windows have changed, [`Pipeline::score_within`] asks the model about some of them, and the next call about others.
//! Scores are of whole windows all the same: those of a person who waits are of the window before. No narration counts as included before
//! every person of whom it tells has been scored with it.
//!
//! The pipeline owns every buffer and does no I/O; the daemon, `roomcast score`, the experiments and the replay all run
//! this one.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::grounding::{GroundedScores, Grounding, GroundingError, GroundingOptions, Regrouped};
use crate::narration::history::{Histories, History, HistoryLimits, Voice};
use crate::narration::{Observation, Presence};
use crate::prepared::{Answer, Outlook, PersonOutlook, PreparedAnswers, Preparer};
use crate::prompt::{BindingSequence, write_prompt};
use crate::scorer::certified::{Bounds, Certified, Effort};
use crate::scorer::correction::{Correction, CorrectionChoice};
use crate::scorer::{
    DecodeStats, IsStopped, LabelScores, LanguageModel, Method, ModelError, ModelInfo, PreparedLabels, Progress,
    ScoreError, Scorer, TextStart, TokenCounter, Tokenisation,
};
use crate::semantic_map::SemanticMap;

/// Most starts of narration sources that scores name; the one heard longest ago makes room for a new one.
pub const SOURCES_MAX: usize = 64;
/// So many steps of what a source said wait for their scores apart from each other; the newest ones wait together.
const TRAIL_MAX: usize = 32;

/// A pipeline that cannot be set up, or a step that failed. Histories are complete all the same.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The scorer failed.
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// The scores cannot be grounded.
    #[error(transparent)]
    Grounding(#[from] GroundingError),
    /// The model's context is too small for a history at all.
    #[error(
        "the context of {context} tokens leaves none for narration: the labels and the binding sequence need {needed}; raise model.context_tokens or use another model"
    )]
    ContextTooSmall {
        /// Tokens of the context.
        context: usize,
        /// Tokens needed beside the narration.
        needed: usize,
    },
}

/// How a pipeline scores.
#[derive(Debug, Clone, PartialEq)]
pub struct PipelineOptions {
    /// The binding sequence.
    pub binding: BindingSequence,
    /// How prompt and labels are cut into tokens.
    pub tokenisation: Tokenisation,
    /// How scores are corrected; what it does not say, the model file does.
    pub correction: CorrectionChoice,
    /// How labels are scored.
    pub method: Method,
    /// How far an answer goes, under [`Method::Trie`]; the other methods are always exact.
    pub effort: Effort,
    /// The time that a step may take under [`Effort::Deadline`], from its start, in nanoseconds.
    pub deadline_ns: u64,
    /// The window of each person.
    pub history: HistoryLimits,
}

impl Default for PipelineOptions {
    fn default() -> Self {
        Self {
            binding: BindingSequence::default(),
            tokenisation: Tokenisation::default(),
            correction: CorrectionChoice::default(),
            method: Method::default(),
            effort: Effort::default(),
            deadline_ns: 5_000_000,
            history: HistoryLimits::default(),
        }
    }
}

/// The last narration of one start of a source that scores include.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Included {
    /// The source.
    pub source: u64,
    /// Its epoch.
    pub epoch: u64,
    /// Its sequence number in that epoch.
    pub sequence: u64,
    /// When it was observed, monotonic nanoseconds.
    pub observed_ns: u64,
    /// How many narrations of this epoch went into the histories.
    pub accepted: u64,
    /// The number of the voice that it was heard as ([`Voice`]).
    pub voice: u64,
    /// Grows with every narration of any source.
    pub turn: u64,
}

/// What a changed map asked of the model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Prepared {
    /// Whether it was prepared for the map's labels again.
    pub again: bool,
    /// How many of them are new.
    pub new_labels: usize,
}

/// Where a step's time went, in nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Timing {
    /// Writing the prompt and cutting it into tokens.
    #[serde(rename = "tokenise")]
    pub tokenise_ns: u64,
    /// Decoder calls that held the prompt; the trie's nodes ride in the same call.
    #[serde(rename = "prefix")]
    pub prefix_ns: u64,
    /// The softmax and the walk over the trie.
    #[serde(rename = "trie")]
    pub trie_ns: u64,
    /// Items and partitions.
    #[serde(rename = "ground")]
    pub ground_ns: u64,
    /// All of the step.
    #[serde(rename = "total")]
    pub total_ns: u64,
}

/// The scores after a step, of all persons together.
#[derive(Debug, Clone, Default)]
pub struct Scores {
    /// Per label `ln s_c` in nats, corrected: of one person. Of several, the mean over persons of their label's share of their label
    /// mass, times the mean label mass: everybody counts the same.
    pub label_log_prob_nats: Vec<f64>,
    /// Per partition: of one person. Of several, the probability that somebody is there next, its logarithm as the score, and the mean
    /// label mass.
    pub grounded: GroundedScores,
    /// Per start of a source, the last narration that these scores include.
    pub included: Vec<Included>,
    /// When the newest of it was observed, monotonic nanoseconds; 0 before the first.
    pub newest_observed_ns: u64,
    /// How the scores were reached; of several persons, what the intervals of all together show.
    pub reached: Effort,
    /// Per partition a certified lower bound of the score in nats; the score itself when exact.
    pub lower_log_score_nats: Vec<f64>,
    /// Per partition a certified upper bound of the score in nats; the score itself when exact.
    pub upper_log_score_nats: Vec<f64>,
    /// Tokens of the prompts scored in this step.
    pub prompt_tokens: usize,
    /// How many prompts the model was asked about in this step.
    pub asked: usize,
    /// How many were answered before they were asked ([`Pipeline::keep_answer`]).
    pub prepared: usize,
    /// What was decoded in this step.
    pub stats: DecodeStats,
    /// Where the time of this step went.
    pub timing: Timing,
}

/// One person's scores: those that they would have alone.
#[derive(Debug, Clone, Copy)]
pub struct PersonScores<'a> {
    /// Who.
    pub person: u32,
    /// In the house. Otherwise they are in no partition.
    pub at_home: bool,
    /// Narrations that the scores were computed from; the history may have been cut since.
    pub window: usize,
    /// Nothing that they rest on has changed since: they are of what the person did last.
    pub is_current: bool,
    /// The number of these scores, which no other ones have; 0 before the first.
    pub number: u64,
    /// Per label `ln s_c` in nats, corrected.
    pub label_log_prob_nats: &'a [f64],
    /// Per partition.
    pub grounded: &'a GroundedScores,
    /// How the scores were reached.
    pub reached: Effort,
    /// Per partition a certified lower bound of `ln S_j` in nats; the score itself when exact.
    pub lower_log_score_nats: &'a [f64],
    /// Per partition a certified upper bound of `ln S_j` in nats; the score itself when exact.
    pub upper_log_score_nats: &'a [f64],
}

/// What a person's scores lack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Due {
    Nothing,
    /// The map's sums.
    Grounding,
    /// The model's word.
    Scoring,
}

/// What a person's scores do not contain yet, of one start of a source: from this narration on.
#[derive(Debug, Clone, Copy)]
struct Unscored {
    source: u64,
    epoch: u64,
    sequence: u64,
    /// The number of the voice that it was heard as.
    voice: u64,
}

/// What was heard of one start of a source.
#[derive(Debug)]
struct Heard {
    /// The last of what the scores contain, and all before it.
    included: Option<Included>,
    /// What came after it, oldest first.
    trail: VecDeque<Included>,
    /// The newest scores do not contain all of it.
    is_late: bool,
}

impl Heard {
    fn newest(&self) -> Option<&Included> {
        self.trail.back().or(self.included.as_ref())
    }

    fn is_of(&self, source: u64, epoch: u64) -> bool {
        self.newest().is_some_and(|newest| (newest.source, newest.epoch) == (source, epoch))
    }
}

#[derive(Debug)]
struct Person {
    id: u32,
    at_home: bool,
    scores: LabelScores,
    grounded: GroundedScores,
    lower_log_score_nats: Vec<f64>,
    upper_log_score_nats: Vec<f64>,
    /// Kept only where partial answers are asked for.
    certified: Option<Certified>,
    due: Due,
    /// The turns of the first and the newest narration that wait for the scores.
    waits_from: u64,
    waits_until: u64,
    unscored: Vec<Unscored>,
    /// They had scores of the map before, and have none of the map in use yet.
    is_owed: bool,
    /// Of the scores, among those of all persons.
    number: u64,
    /// What the model read for these scores, and where in it each sentence ends: the history may have been cut since.
    prompt: String,
    sentence_ends: Vec<usize>,
    window: usize,
}

impl Person {
    fn new(id: u32) -> Self {
        Self {
            id,
            at_home: true,
            scores: LabelScores::default(),
            grounded: GroundedScores::default(),
            lower_log_score_nats: Vec::new(),
            upper_log_score_nats: Vec::new(),
            certified: None,
            due: Due::Scoring,
            waits_from: 0,
            waits_until: 0,
            unscored: Vec::new(),
            is_owed: false,
            number: 0,
            prompt: String::new(),
            sentence_ends: Vec::new(),
            window: 0,
        }
    }

    /// The model has to be asked about them.
    fn waits(&self) -> bool {
        self.at_home && self.due == Due::Scoring
    }

    /// They have scores of the map in use.
    fn is_scored(&self) -> bool {
        !self.grounded.partition_probability.is_empty()
    }

    /// For whom the model would be asked about them: for those who told of them, and for nobody where time alone has changed their scores.
    fn voices(&self) -> impl Iterator<Item = u64> {
        let of_none = self.unscored.is_empty().then_some(Voice::EARLIER.number);
        self.unscored.iter().map(|own| own.voice).chain(of_none)
    }

    /// The model has to be asked about them from this turn on.
    fn wait_from(&mut self, turn: u64) {
        if self.due != Due::Scoring {
            self.waits_from = turn;
        }
        (self.due, self.waits_until) = (Due::Scoring, turn);
    }

    /// Writes the prompt for what is known of the person.
    fn write_prompt(&mut self, history: Option<&History>, options: &PipelineOptions) {
        let trailing_space = options.tokenisation == Tokenisation::Paper;
        let sentences = || history.into_iter().flat_map(History::sentences);
        write_prompt(sentences(), &options.binding, trailing_space, &mut self.prompt);
        self.window = history.map_or(0, History::len);
        self.sentence_ends.clear();
        if options.binding.uses_narration() {
            let mut end = 0;
            for sentence in sentences() {
                end += sentence.len();
                self.sentence_ends.push(end);
                end += 1;
            }
        }
    }

    /// The bounds of an answer that stopped before it was exact.
    fn partial(&self) -> Option<&Bounds> {
        self.certified.as_ref().map(|certified| &certified.bounds).filter(|bounds| bounds.reached != Effort::Exact)
    }

    fn reached(&self) -> Effort {
        self.partial().map_or(Effort::Exact, |bounds| bounds.reached)
    }

    /// Sums the labels' scores per partition.
    fn ground(&mut self, grounding: &Grounding) -> Result<(), GroundingError> {
        if self.at_home {
            grounding.ground(&self.scores.log_prob_nats, &mut self.grounded)?;
        } else {
            self.scores.log_prob_nats.clear();
            self.scores.log_prob_nats.resize(grounding.scored_labels().len(), f64::NEG_INFINITY);
            self.grounded.nowhere(grounding.partitions().len());
            self.certified = None;
            (self.window, self.prompt, self.sentence_ends) = Default::default();
        }
        let (mut lower, mut upper) =
            (std::mem::take(&mut self.lower_log_score_nats), std::mem::take(&mut self.upper_log_score_nats));
        lower.clear();
        upper.clear();
        match self.partial() {
            Some(bounds) => {
                lower.extend(bounds.lower.iter().map(|score| score.ln()));
                upper.extend(bounds.upper.iter().map(|score| score.ln()));
            }
            None => {
                lower.extend_from_slice(&self.grounded.partition_log_score_nats);
                upper.extend_from_slice(&self.grounded.partition_log_score_nats);
            }
        }
        (self.lower_log_score_nats, self.upper_log_score_nats) = (lower, upper);
        Ok(())
    }

    /// Between what the probability of a partition lies: its least score against the most of all others, and its most against their least.
    fn probability_bounds(&self, partition: usize) -> (f64, f64) {
        let Some(Bounds { lower, upper, .. }) = self.partial() else {
            let exact = self.grounded.partition_probability[partition];
            return (exact, exact);
        };
        let even = 1.0 / lower.len() as f64;
        let others = |side: &[f64]| -> f64 {
            side.iter().enumerate().filter(|(other, _)| *other != partition).map(|(_, score)| score).sum()
        };
        // Where no partition has a score, all are as likely.
        let share = |own: f64, others: f64| if own + others > 0.0 { own / (own + others) } else { even };
        (share(lower[partition], others(upper)), share(upper[partition], others(lower)))
    }

    fn view(&self) -> PersonScores<'_> {
        PersonScores {
            person: self.id,
            at_home: self.at_home,
            window: self.window,
            is_current: self.due == Due::Nothing,
            number: self.number,
            label_log_prob_nats: &self.scores.log_prob_nats,
            grounded: &self.grounded,
            reached: self.reached(),
            lower_log_score_nats: &self.lower_log_score_nats,
            upper_log_score_nats: &self.upper_log_score_nats,
        }
    }

    fn sentences(&self) -> impl Iterator<Item = &str> {
        let starts = std::iter::once(0).chain(self.sentence_ends.iter().map(|end| end + 1));
        starts.zip(&self.sentence_ends).map(|(start, &end)| &self.prompt[start..end])
    }
}

/// The flow from observations to scores. See the [module's documentation](self).
#[derive(Debug)]
pub struct Pipeline<M> {
    scorer: Scorer<M>,
    prepared: Arc<PreparedLabels>,
    grounding: Grounding,
    options: PipelineOptions,
    /// Most tokens that a history was given; a map's labels may leave it fewer.
    history_tokens: usize,
    histories: Histories,
    /// In the order of their numbers, so that sums do not depend on who came first.
    persons: Vec<Person>,
    /// Stands in before anybody was observed.
    nobody: Person,
    prompt: String,
    /// The person whose prompt was scored last.
    read: Option<u32>,
    /// The model has not read all of their narration: the scores were ready, or the window was cut.
    is_unread: bool,
    /// Narrations included so far.
    turns: u64,
    /// How often persons' scores were grounded.
    groundings: u64,
    /// What was heard of each start of a source.
    heard: Vec<Heard>,
    newest_observed_ns: u64,
    /// Tokens that the model was given for each voice whose persons wait, and where the one stood that was served last.
    given: BTreeMap<u64, u64>,
    given_last: u64,
    /// Per start of a source up to which sequence a former run has dealt with it, and does not tell of it any more.
    settled: BTreeMap<(u64, u64), u64>,
    answers: PreparedAnswers,
    scores: Scores,
}

impl<M: LanguageModel> Pipeline<M> {
    /// Cuts the map's labels into tokens, builds their trie and learns the prior, once.
    ///
    /// # Errors
    /// When a label has no tokens, the model's context leaves no room for narration, or the model fails at a blank one.
    pub fn new(model: M, grounding: Grounding, mut options: PipelineOptions) -> Result<Self, PipelineError> {
        let mut scorer = Scorer::new(model);
        let (prepared, tokens) = prepare(&mut scorer, &grounding, &options)?;
        let history_tokens = options.history.tokens;
        options.history.tokens = history_tokens.min(tokens);
        let histories = Histories::new(options.history);
        Ok(Self {
            scorer,
            prepared: Arc::new(prepared),
            grounding,
            options,
            history_tokens,
            histories,
            persons: Vec::new(),
            nobody: Person::new(0),
            prompt: String::new(),
            read: None,
            is_unread: false,
            turns: 0,
            groundings: 0,
            heard: Vec::new(),
            newest_observed_ns: 0,
            given: BTreeMap::new(),
            given_last: 0,
            settled: BTreeMap::new(),
            answers: PreparedAnswers::default(),
            scores: Scores::default(),
        })
    }

    /// What the model says of itself.
    pub fn model(&self) -> &ModelInfo {
        self.scorer.info()
    }

    /// The map's labels and partitions.
    pub fn grounding(&self) -> &Grounding {
        &self.grounding
    }

    /// The labels' tokens and trie.
    pub fn prepared(&self) -> &PreparedLabels {
        &self.prepared
    }

    /// The same, for whoever works ahead.
    pub fn labels(&self) -> Arc<PreparedLabels> {
        Arc::clone(&self.prepared)
    }

    /// How this pipeline scores.
    pub fn options(&self) -> &PipelineOptions {
        &self.options
    }

    /// Takes a changed map. As long as it brings no label that the model was not prepared for, and under a correction lets none go, the
    /// model is not touched: the next [`Pipeline::score`] sums the known label scores again.
    ///
    /// Partial answers ([`PipelineOptions::effort`]) know their labels only as far as the old map asked; they are scored again.
    ///
    /// # Errors
    /// When the map cannot be grounded, its labels leave no room for narration, or the model fails; the old map stays in use then.
    pub fn change_map(&mut self, map: &SemanticMap, options: &GroundingOptions) -> Result<Prepared, PipelineError> {
        let Regrouped { grounding, new_labels } = self.grounding.regroup(map, options)?;
        // Corrected scores depend on the labels that there are.
        let others_gone = self.prepared.correction() != Correction::default() && grounding.has_idle_labels();
        let again = new_labels > 0 || others_gone;
        let prepared = Prepared { again, new_labels };
        if !again {
            self.grounding = grounding;
        } else {
            // The list is prepared again, so labels that nothing bears any more can leave it.
            let grounding = Grounding::new(map, options)?;
            let (labels, tokens) = prepare(&mut self.scorer, &grounding, &self.options)?;
            self.options.history.tokens = self.history_tokens.min(tokens);
            self.histories.limit_tokens(self.options.history.tokens);
            self.prepared = Arc::new(labels);
            self.grounding = grounding;
            self.answers.clear();
            // Scores of the old list, in the old order.
            self.scores.label_log_prob_nats.clear();
        }
        let exact = self.options.method != Method::Trie || self.options.effort == Effort::Exact;
        let due = if again || !exact { Due::Scoring } else { Due::Grounding };
        for person in self.persons.iter_mut().chain([&mut self.nobody]) {
            // It holds the old map's weights.
            person.certified = None;
            // Of the old map's partitions.
            person.grounded = GroundedScores::default();
            person.due = person.due.max(due);
            person.is_owed = true;
        }
        Ok(prepared)
    }

    /// The sentences that the model read for the newest scores, with their person, oldest first.
    pub fn read_sentences(&self) -> impl Iterator<Item = (u32, &str)> {
        self.persons.iter().flat_map(|person| person.sentences().map(|sentence| (person.id, sentence)))
    }

    /// The histories of all persons.
    pub fn histories(&self) -> &Histories {
        &self.histories
    }

    /// The scores of the last step.
    pub fn scores(&self) -> &Scores {
        &self.scores
    }

    /// Each person's own scores, as far as the map in use has given them any, in the order of their numbers.
    pub fn persons(&self) -> impl Iterator<Item = PersonScores<'_>> {
        self.persons.iter().filter(|person| person.is_scored()).map(Person::view)
    }

    /// One person's own scores, if they have any.
    #[must_use]
    pub fn person(&self, person: u32) -> Option<PersonScores<'_>> {
        self.persons().find(|scores| scores.person == person)
    }

    /// Whether the model has to be asked about a person: their scores are of what they did before, or there are none yet.
    #[must_use]
    pub fn waits(&self, person: u32) -> bool {
        self.persons.iter().any(|own| own.id == person && own.waits())
    }

    /// Whether the model has to be asked about anybody.
    #[must_use]
    pub fn is_behind(&self) -> bool {
        self.persons.iter().any(Person::waits)
    }

    /// Whether somebody who had scores of the map before has none of the map in use.
    #[must_use]
    pub fn is_owing(&self) -> bool {
        self.persons.iter().any(|own| own.at_home && own.is_owed)
    }

    /// Has `moved` called after each call of the decoder: a thread that works so long is not taken for one that stands still.
    pub fn watch(&mut self, moved: Progress) {
        self.scorer.watch(moved);
    }

    /// Counts the tokens that a sentence costs, on any thread; with the one behind it that is held against
    /// [`HistoryLimits::tokens`] of [`Pipeline::options`].
    pub fn token_counter(&self) -> TokenCounter {
        self.scorer.model().token_counter()
    }

    /// A token's text, for people.
    pub fn token_text(&self, token: crate::scorer::Token) -> String {
        self.scorer.model().token_text(token)
    }

    /// Per token of a label ln p(token | prompt and the tokens before it), corrected, in nats, of the last step; none where several
    /// persons were scored or the method keeps no such numbers.
    #[must_use]
    pub fn token_log_prob_nats(&self, label: usize) -> Option<Vec<f64>> {
        let exact_trie = self.options.method == Method::Trie && self.options.effort == Effort::Exact;
        // What was read last may be somebody else's, who was forgotten since.
        let is_read = |person: &Person| person.at_home && self.read == Some(person.id);
        if exact_trie && self.persons.len() <= 1 && self.persons.iter().all(is_read) {
            self.scorer.token_log_prob_nats(&self.prepared, label)
        } else {
            None
        }
    }

    /// What the prior added to the sum over a label's tokens, in nats, in the last step; 0 without one, and where several persons were
    /// scored.
    #[must_use]
    pub fn prior_nats(&self, label: usize) -> f64 {
        match self.persons.as_slice() {
            [] => self.prior_nats_of(&self.nobody, label),
            [person] => self.prior_nats_of(person, label),
            _ => 0.0,
        }
    }

    /// The same for one person; 0 for somebody unknown.
    #[must_use]
    pub fn prior_nats_of_person(&self, person: u32, label: usize) -> f64 {
        let own = self.persons.iter().find(|known| known.id == person);
        own.map_or(0.0, |own| self.prior_nats_of(own, label))
    }

    fn prior_nats_of(&self, person: &Person, label: usize) -> f64 {
        self.prepared.gain_nats().get(label).map_or(0.0, |gain_nats| gain_nats + person.scores.scale_nats)
    }

    /// Enters observations into the histories without scoring, each source for itself: nothing can fail here, and nothing is lost when the
    /// scoring after it does. Who is said to leave loses their window, and who is gone is forgotten. Gives how many sentences cost more
    /// tokens than a window holds; those are left out, since nothing could be scored with them.
    pub fn observe(&mut self, observations: impl IntoIterator<Item = Observation>) -> usize {
        self.hear(observations.into_iter().map(|observation| (Voice::of_source(observation.source), observation)))
    }

    /// As [`Pipeline::observe`], each for its voice.
    pub fn hear(&mut self, observations: impl IntoIterator<Item = (Voice, Observation)>) -> usize {
        let mut costly = 0;
        for (voice, observation) in observations {
            let tokens = observation.sentence().map(|text| self.scorer.cost_of(text));
            if tokens.is_some_and(|tokens| tokens > self.options.history.tokens) {
                costly += 1;
                self.pass_over(observation.source, observation.epoch, observation.sequence);
                continue;
            }
            self.include(&observation, voice);
            self.enter_of(voice, observation, tokens);
        }
        costly
    }

    /// Enters an observation into its person's history, and does not take note that the scores contain it: see [`Pipeline::include`].
    pub fn enter(&mut self, voice: Voice, observation: Observation) {
        let tokens = observation.sentence().map(|text| self.scorer.cost_of(text));
        self.enter_of(voice, observation, tokens);
    }

    fn enter_of(&mut self, voice: Voice, observation: Observation, tokens: Option<usize>) {
        let (person, presence) = (observation.person, observation.said.presence());
        let Observation { source, epoch, sequence, .. } = observation;
        if presence == Presence::Gone {
            self.forget_person(person);
            return;
        }
        let at_home = presence != Presence::Away;
        let history = self.histories.known(person);
        let changed = match tokens {
            Some(tokens) => {
                history.hear(observation, voice, tokens);
                true
            }
            None => !at_home && history.end() > 0,
        };
        let place = self.persons.binary_search_by_key(&person, |known| known.id);
        let place = place.unwrap_or_else(|place| {
            self.persons
                .insert(place, Person { waits_from: self.turns, waits_until: self.turns, ..Person::new(person) });
            place
        });
        let own = &mut self.persons[place];
        if own.at_home != at_home {
            // Until the next step says where they are.
            own.grounded = GroundedScores::default();
        }
        if changed || own.at_home != at_home {
            own.at_home = at_home;
            if at_home {
                own.wait_from(self.turns);
            } else {
                own.due = Due::Grounding;
            }
        }
        if own.due != Due::Nothing && !own.unscored.iter().any(|known| (known.source, known.epoch) == (source, epoch)) {
            own.unscored.push(Unscored { source, epoch, sequence, voice: voice.number });
        }
        self.persons.retain(|p| self.histories.get(p.id).is_some());
    }

    /// Whether a sentence alone costs more tokens than a window holds, so that nothing could be scored with it.
    pub fn is_costly(&mut self, observation: &Observation) -> bool {
        let most = self.options.history.tokens;
        // No tokeniser makes more tokens than bytes, a space before the sentence, and the one behind it.
        observation.sentence().is_some_and(|text| text.len() + 2 > most && self.scorer.cost_of(text) > most)
    }

    /// All that was heard so far is of a former run: whose voice it was is not known any more.
    ///
    /// Of those about whom the model has not been asked since, whoever was heard of last comes first.
    pub fn forget_voices(&mut self) {
        self.histories.forget_voices();
        for own in &mut self.persons {
            own.unscored.iter_mut().for_each(|unscored| unscored.voice = Voice::EARLIER.number);
            own.waits_from = u64::MAX - own.waits_until;
        }
    }

    /// Ends a person's window: nothing was observed of them for so long that it does not say what comes next. Returns whether that changes
    /// their scores, which the next step computes.
    pub fn end_window(&mut self, person: u32) -> bool {
        let ended = self.histories.get_mut(person).is_some_and(|history| history.end() > 0);
        if let Some(own) = self.persons.iter_mut().find(|own| ended && own.id == person) {
            own.wait_from(self.turns);
        }
        ended
    }

    /// Takes note that a narration was dealt with and is in no history, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, source: u64, epoch: u64, sequence: u64) {
        self.note(source, epoch, |included| included.sequence = included.sequence.max(sequence));
    }

    /// Takes note of an observation that the next scores contain, of however many persons it is, also of none.
    pub fn include(&mut self, observation: &Observation, voice: Voice) {
        let settled = self.settled_of(observation.source, observation.epoch);
        let observed_ns = observation.observed_ns;
        self.newest_observed_ns = self.newest_observed_ns.max(observed_ns);
        self.turns += 1;
        let turn = self.turns;
        self.note(observation.source, observation.epoch, |included| {
            // What was refused after it may be named already.
            included.sequence = included.sequence.max(observation.sequence);
            included.accepted += u64::from(observation.sequence > settled);
            (included.observed_ns, included.voice, included.turn) = (observed_ns, voice.number, turn);
        });
    }

    /// Takes note up to which sequence a former run has dealt with the starts of sources. Which of it was accepted nobody can say any more, so
    /// all of it counts as accepted.
    pub fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.settled = settled;
    }

    fn settled_of(&self, source: u64, epoch: u64) -> u64 {
        self.settled.get(&(source, epoch)).copied().unwrap_or_default()
    }

    /// Takes note of what was heard of one start of a source, known or new, until the scores contain it.
    fn note(&mut self, source: u64, epoch: u64, change: impl FnOnce(&mut Included)) {
        let accepted = self.settled_of(source, epoch);
        let known = self.heard.iter().position(|heard| heard.is_of(source, epoch));
        let place = known.unwrap_or_else(|| {
            let turn = |heard: &Heard| heard.newest().map_or(0, |newest| newest.turn);
            if self.heard.len() >= SOURCES_MAX
                && let Some(oldest) = (0..self.heard.len()).min_by_key(|&i| turn(&self.heard[i]))
            {
                self.heard.swap_remove(oldest);
            }
            self.heard.push(Heard { included: None, trail: VecDeque::new(), is_late: false });
            self.heard.len() - 1
        });
        let heard = &mut self.heard[place];
        let none = Included { source, epoch, sequence: 0, observed_ns: 0, accepted, voice: 0, turn: 0 };
        let mut newest = heard.newest().copied().unwrap_or(none);
        change(&mut newest);
        if heard.trail.len() >= TRAIL_MAX {
            heard.trail.pop_back();
        }
        heard.trail.push_back(newest);
    }

    /// Says what the newest scores include: of each source all before the first narration with which somebody has not been scored.
    fn tell_included(&mut self) {
        let Self { heard, persons, scores, turns, .. } = self;
        scores.included.clear();
        let mut is_late = false;
        for own in heard {
            let Some(&Included { source, epoch, .. }) = own.newest() else { continue };
            let unscored = persons.iter().flat_map(|person| &person.unscored);
            let first = unscored.filter(|known| (known.source, known.epoch) == (source, epoch));
            let first = first.map(|known| known.sequence).min().unwrap_or(u64::MAX);
            let news = own.trail.iter().take_while(|next| next.sequence < first).count();
            if let Some(mut included) = own.trail.drain(..news).next_back() {
                if own.is_late {
                    // It is news now, however long ago it was heard.
                    *turns += 1;
                    included.turn = *turns;
                }
                own.included = Some(included);
            }
            own.is_late = !own.trail.is_empty();
            is_late |= own.is_late;
            scores.included.extend(own.included);
        }
        let observed_ns = scores.included.iter().map(|included| included.observed_ns).max().unwrap_or_default();
        let newest_ns = if is_late { observed_ns } else { self.newest_observed_ns };
        scores.newest_observed_ns = scores.newest_observed_ns.max(newest_ns);
    }

    /// Forgets a start of a source, which gave way to another one.
    pub fn forget_source(&mut self, source: u64, epoch: u64) {
        self.heard.retain(|heard| !heard.is_of(source, epoch));
    }

    /// Forgets a person, for instance one who has left the map.
    pub fn forget_person(&mut self, person: u32) {
        // Their prompts hold what they did.
        self.answers.clear();
        self.histories.remove(person);
        self.persons.retain(|p| p.id != person);
    }

    /// Takes out of everybody's history what `is_it` says; the next step scores whom it was of without it.
    pub fn forget_told(&mut self, is_it: impl Fn(&Observation) -> bool) {
        let changed = self.histories.forget(is_it);
        if !changed.is_empty() {
            self.answers.clear();
        }
        let turn = self.turns;
        let theirs = self.persons.iter_mut().filter(|own| changed.contains(&own.id) && own.at_home);
        theirs.for_each(|own| own.wait_from(turn));
    }

    /// Scores the persons whose history changed since the last step, and grounds the result. Before anything was
    /// observed, the binding sequence alone is scored.
    ///
    /// # Errors
    /// When the model fails. The histories stay, and the next step scores what this one could not.
    pub fn score(&mut self) -> Result<&Scores, PipelineError> {
        self.score_within(u64::MAX)
    }

    /// As [`Pipeline::score`], but once `patience_ns` have passed the model is asked about nobody else: the next call goes on
    /// ([`Pipeline::is_behind`]). One is always asked about.
    ///
    /// Whoever tells of many persons delays others' persons by one call at most, which is `patience_ns` and one prompt: of all voices, the one
    /// comes next for which the model has read least, and of its persons the one who has waited longest.
    ///
    /// # Errors
    /// As [`Pipeline::score`].
    pub fn score_within(&mut self, patience_ns: u64) -> Result<&Scores, PipelineError> {
        let now = self.scorer.model().clock();
        let start = now();
        let mut timing = Timing::default();
        self.scores.stats = DecodeStats::default();
        (self.scores.prompt_tokens, self.scores.asked, self.scores.prepared) = (0, 0, 0);
        if self.persons.is_empty() {
            let mut nobody = std::mem::replace(&mut self.nobody, Person::new(0));
            let asked = if nobody.waits() { self.ask(&mut nobody, start, &mut timing) } else { Ok(()) };
            self.nobody = nobody;
            asked?;
        }
        while let Some((place, voice)) = self.next_person() {
            if self.scores.asked > 0 && now().saturating_sub(start) >= patience_ns {
                break;
            }
            let before = self.scores.stats;
            let mut person = std::mem::replace(&mut self.persons[place], Person::new(0));
            let asked = self.ask(&mut person, start, &mut timing);
            self.persons[place] = person;
            asked?;
            let stats = self.scores.stats;
            let given = (stats.prompt_tokens_decoded - before.prompt_tokens_decoded)
                + (stats.tree_tokens_decoded - before.tree_tokens_decoded);
            self.given_last = self.given_of(voice);
            self.given.insert(voice, self.given_last + u64::from(given));
        }
        let grounding = now();
        let persons = match self.persons.as_mut_slice() {
            [] => std::slice::from_mut(&mut self.nobody),
            persons => persons,
        };
        for person in persons.iter_mut().filter(|p| p.due != Due::Nothing && !p.waits()) {
            person.ground(&self.grounding)?;
            (person.due, person.is_owed) = (Due::Nothing, false);
            person.unscored.clear();
            self.groundings += 1;
            person.number = self.groundings;
        }
        together(persons, &mut self.scores);
        self.tell_included();
        let persons = &self.persons;
        self.given
            .retain(|voice, _| persons.iter().any(|own| own.waits() && own.voices().any(|other| other == *voice)));
        timing.ground_ns = now().saturating_sub(grounding);
        timing.total_ns = now().saturating_sub(start);
        self.scores.timing = timing;
        Ok(&self.scores)
    }

    /// How much the model has read for a voice; for one that has not waited so far, as much as for the one that was served last.
    fn given_of(&self, voice: u64) -> u64 {
        self.given.get(&voice).copied().unwrap_or(self.given_last)
    }

    /// About whom the model is asked next, and for whose voice.
    fn next_person(&self) -> Option<(usize, u64)> {
        let waiting = self.persons.iter().enumerate().filter(|(_, own)| own.waits());
        let ways = waiting.flat_map(|(place, own)| own.voices().map(move |voice| (place, voice)));
        ways.min_by_key(|(place, voice)| (self.given_of(*voice), self.persons[*place].waits_from, *place))
    }

    /// Asks the model about one person, in a step that began at `start`.
    fn ask(&mut self, person: &mut Person, start: u64, timing: &mut Timing) -> Result<(), PipelineError> {
        let now = self.scorer.model().clock();
        let writing = now();
        person.write_prompt(self.histories.get(person.id), &self.options);
        timing.tokenise_ns += now().saturating_sub(writing);
        self.scores.asked += 1;
        let is_prepared = self.keeps_answers()
            && self.answers.take(&person.prompt, |answer| {
                std::mem::swap(&mut person.scores, &mut answer.scores);
                self.scorer.exchange_nodes(&mut answer.node_log_prob_nats);
            });
        (self.read, self.is_unread) = (Some(person.id), is_prepared);
        if is_prepared {
            person.due = Due::Grounding;
            self.scores.prompt_tokens += person.scores.prompt_tokens;
            self.scores.prepared += 1;
            return Ok(());
        }
        if self.options.method == Method::Trie && self.options.effort != Effort::Exact {
            let state =
                (person.certified).get_or_insert_with(|| Certified::new(&self.prepared, &self.grounding.weights));
            let deadline_ns = start.saturating_add(self.options.deadline_ns);
            self.scorer.score_certified(
                &self.prepared,
                state,
                &person.prompt,
                self.options.effort,
                Some(deadline_ns),
                &mut person.scores,
            )?;
        } else {
            self.scorer.score(&self.prepared, &person.prompt, self.options.method, &mut person.scores)?;
        }
        person.due = Due::Grounding;
        timing.tokenise_ns += person.scores.tokenise_ns;
        timing.prefix_ns += person.scores.prefix_ns;
        timing.trie_ns += person.scores.trie_ns;
        self.scores.prompt_tokens += person.scores.prompt_tokens;
        self.scores.stats += person.scores.stats;
        Ok(())
    }

    /// Whether answers can be prepared: exact ones by the trie.
    fn keeps_answers(&self) -> bool {
        self.options.method == Method::Trie && self.options.effort == Effort::Exact
    }

    /// What scores ahead for this pipeline, on any thread; it stops within a small step of the model where `is_stopped` says so. None where
    /// nothing can be prepared: without a model, and of answers that are not exact.
    ///
    /// # Errors
    /// When the model has no memory for a second cache.
    pub fn preparer(&self, is_stopped: IsStopped) -> Result<Option<Preparer<M>>, ModelError> {
        if !self.keeps_answers() {
            return Ok(None);
        }
        Ok(self.scorer.model().twin(is_stopped)?.map(Preparer::new))
    }

    /// What says which prompts may come next. Kept answers that are stale are dropped.
    pub fn outlook(&mut self) -> Outlook {
        let round = self.answers.begin(&self.histories);
        let of = |(person, history): (u32, &History)| {
            let own = self.persons.iter().find(|own| own.id == person && own.at_home && own.due == Due::Nothing);
            let label_log_prob_nats = own.map(|own| own.scores.log_prob_nats.clone()).unwrap_or_default();
            PersonOutlook { person, history: history.clone(), label_log_prob_nats }
        };
        Outlook::new(&self.prepared, self.histories.iter().map(of).collect(), round)
    }

    /// Keeps an answer for when it is asked for, and gives whether it is of use: not where its person has done something else since, the
    /// labels are other ones, or there are [`crate::prepared::ANSWERS_MAX`] of theirs. Another person's may go for it.
    pub fn keep_answer(&mut self, answer: Answer) -> bool {
        self.answers.keep(answer, &self.histories)
    }

    /// Observes, then scores.
    ///
    /// # Errors
    /// As [`Pipeline::score`]; the observations are in the histories all the same.
    pub fn step(&mut self, observations: impl IntoIterator<Item = Observation>) -> Result<&Scores, PipelineError> {
        self.observe(observations);
        self.score()
    }

    /// A small part of the work that can wait until no event does: clears the model's cache of what the next event cannot use, cuts the
    /// history windows that are full, and reads narration that the model has not read yet, so that no event waits for it. Gives whether there
    /// is more.
    pub fn tidy(&mut self) -> bool {
        self.scorer.tidy();
        let Some(person) = self.read else { return false };
        let Some(history) = self.histories.get_mut(person) else { return false };
        self.is_unread |= history.compact() > 0;
        if !self.is_unread || !self.options.binding.uses_narration() {
            return false;
        }
        self.prompt.clear();
        for sentence in history.sentences() {
            if !self.prompt.is_empty() {
                self.prompt.push(' ');
            }
            self.prompt.push_str(sentence);
        }
        // A failure costs the next event time, and shows there if it lasts.
        self.is_unread = !self.scorer.read_ahead(&self.prompt).unwrap_or_else(|error| {
            tracing::debug!(%error, "failed to read narration ahead");
            true
        });
        self.is_unread
    }
}

/// The map's labels ready to be scored, and how many tokens they and the binding sequence leave for narration.
fn prepare<M: LanguageModel>(
    scorer: &mut Scorer<M>,
    grounding: &Grounding,
    options: &PipelineOptions,
) -> Result<(PreparedLabels, usize), PipelineError> {
    let correction = options.correction.or(scorer.info().correction);
    let mut prepared = scorer.cut(&grounding.label_texts(), &options.binding, options.tokenisation, correction)?;
    let mut binding = Vec::new();
    scorer.model().tokenise(options.binding.text(), TextStart::Sequence, &mut binding).map_err(ScoreError::from)?;
    let context = scorer.info().context_tokens;
    let needed = binding.len() + prepared.trie().inner().len() + prepared.longest_label() + 1;
    if needed >= context {
        return Err(PipelineError::ContextTooSmall { context, needed });
    }
    scorer.learn_prior(&mut prepared)?;
    Ok((prepared, context - needed))
}

/// The scores of all persons together who are in the house and have scores; without anybody there, no partition is likely.
fn together(persons: &[Person], scores: &mut Scores) {
    let scored = || persons.iter().filter(|person| person.is_scored());
    let at_home = || scored().filter(|person| person.at_home);
    let count = at_home().count();
    let Some(first) = at_home().next().or(scored().next()) else { return };
    if count <= 1 {
        scores.label_log_prob_nats.clone_from(&first.scores.log_prob_nats);
        scores.grounded.copy_from(&first.grounded);
        scores.lower_log_score_nats.clone_from(&first.lower_log_score_nats);
        scores.upper_log_score_nats.clone_from(&first.upper_log_score_nats);
        scores.reached = first.reached();
        return;
    }
    let count = count as f64;
    let label_mass = at_home().map(|person| person.grounded.label_mass).sum::<f64>() / count;
    let label = |label: usize| {
        let share = |person: &Person| match person.grounded.label_mass {
            mass if mass > 0.0 => person.scores.log_prob_nats[label].exp() / mass,
            _ => 0.0,
        };
        (at_home().map(share).sum::<f64>() / count * label_mass).ln()
    };
    scores.label_log_prob_nats.clear();
    scores.label_log_prob_nats.extend((0..first.scores.log_prob_nats.len()).map(label));

    let partitions = first.grounded.partition_probability.len();
    // 1 - prod(1 - p), exact for small p too.
    let anybody = |of: &dyn Fn(&Person) -> f64| -at_home().map(|person| (-of(person)).ln_1p()).sum::<f64>().exp_m1();
    scores.grounded.set(label_mass, (0..partitions).map(|j| anybody(&|p| p.grounded.partition_probability[j])));
    let score = &scores.grounded.partition_log_score_nats;
    scores.lower_log_score_nats.clone_from(score);
    scores.upper_log_score_nats.clone_from(score);
    scores.reached = Effort::Exact;
    if at_home().all(|person| person.partial().is_none()) {
        return;
    }
    for (partition, &score) in score.iter().enumerate() {
        // Rounding must not put the score itself outside.
        let lower = anybody(&|person| person.probability_bounds(partition).0).ln();
        scores.lower_log_score_nats[partition] = lower.min(score);
        let upper = anybody(&|person| person.probability_bounds(partition).1).ln();
        scores.upper_log_score_nats[partition] = upper.max(score);
    }
    // What is certain of each person is not of all together: only the intervals tell.
    let (lower, upper) = (&scores.lower_log_score_nats, &scores.upper_log_score_nats);
    let all = 0..partitions;
    let ahead = |first: usize, second: usize| lower[first] > upper[second];
    let is_separate = |a: usize| (0..a).all(|b| ahead(a, b) || ahead(b, a));
    let first = |a: usize| all.clone().all(|b| a == b || ahead(a, b));
    scores.reached = if all.clone().all(is_separate) {
        Effort::Ranking
    } else if all.clone().any(first) {
        Effort::Top
    } else {
        Effort::Deadline
    };
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::label_trie::TokenTree;
    use crate::narration::{PresenceStatement, Said, Sentence};
    use crate::scorer::correction::Continuation;
    use crate::scorer::table::TableModel;
    use crate::scorer::{ModelError, Token};
    use crate::semantic_map::delta::MapChange;

    const TWO_ROOMS: &str = include_str!("../../tests/data/two_rooms.json");
    const CORRECTED: CorrectionChoice = CorrectionChoice { continuation: Some(Continuation::Labels), prior: Some(0.4) };

    fn pipeline(map: &SemanticMap, effort: Effort, correction: CorrectionChoice) -> Pipeline<TableModel> {
        pipeline_of(TableModel::new(7), map, effort, correction)
    }

    fn pipeline_of<M: LanguageModel>(
        model: M,
        map: &SemanticMap,
        effort: Effort,
        correction: CorrectionChoice,
    ) -> Pipeline<M> {
        let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
        let options = PipelineOptions { effort, correction, ..PipelineOptions::default() };
        Pipeline::new(model, grounding, options).unwrap()
    }

    /// A fake whose rows depend on all of the prompt, where the table's depend on its last tokens.
    struct WholePrompt(TableModel);

    impl LanguageModel for WholePrompt {
        fn info(&self) -> &ModelInfo {
            self.0.info()
        }

        fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
            self.0.tokenise(text, start, out)
        }

        fn token_text(&self, token: Token) -> String {
            self.0.token_text(token)
        }

        fn forget(&mut self) {}

        fn decode(
            &mut self,
            prompt: &[Token],
            tree: &TokenTree,
            want_prompt_row: bool,
            visit: &mut dyn FnMut(usize, &[f32]),
        ) -> Result<DecodeStats, ModelError> {
            let seed = prompt
                .iter()
                .fold(7, |seed: u64, token| (seed ^ u64::from(token.0.cast_unsigned())).wrapping_mul(0x100_0000_01b3));
            TableModel::new(seed).decode(prompt, tree, want_prompt_row, visit)
        }

        fn tidy(&mut self, _keep: usize) {}

        fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError> {
            Ok(Some(Self(self.0.clone())))
        }
    }

    /// A fake that gives other rows than it is asked for: it says which.
    struct Careless(TableModel, fn(usize) -> Option<usize>);

    impl LanguageModel for Careless {
        fn info(&self) -> &ModelInfo {
            self.0.info()
        }

        fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
            self.0.tokenise(text, start, out)
        }

        fn token_text(&self, token: Token) -> String {
            self.0.token_text(token)
        }

        fn forget(&mut self) {}

        fn decode(
            &mut self,
            prompt: &[Token],
            tree: &TokenTree,
            want_prompt_row: bool,
            visit: &mut dyn FnMut(usize, &[f32]),
        ) -> Result<DecodeStats, ModelError> {
            let Self(table, given) = self;
            table.decode(prompt, tree, want_prompt_row, &mut |row, logits| {
                given(row).into_iter().for_each(|row| visit(row, logits));
            })
        }

        fn tidy(&mut self, _keep: usize) {}

        fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError> {
            Ok(None)
        }
    }

    /// Whoever brings a model is told of it, in place of scores that are wrong, or none for ever.
    #[test]
    fn a_model_that_forgets_a_row_is_refused() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let wrong: [fn(usize) -> Option<usize>; 4] =
            [|_| None, |row| (row % 2 == 0).then_some(row), |row| (row != 0).then_some(row), |row| Some(row + 1)];
        for given in wrong {
            for effort in [Effort::Exact, Effort::Ranking, Effort::Top] {
                let correction = CorrectionChoice { prior: Some(0.0), ..CorrectionChoice::default() };
                let mut own = pipeline_of(Careless(TableModel::new(7), given), &map, effort, correction);
                own.observe([observation(1, 1)]);
                let told = own.score().map(|_| ()).unwrap_err().to_string();
                assert!(told.contains("rows of logits"), "{told}");
            }
        }
    }

    /// Somebody who tells of many persons, also of one of another's, delays the other by one prompt at most.
    #[test]
    fn who_tells_of_many_persons_delays_nobody_elses() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let mut pipeline = pipeline_of(TableModel::slow(7), &map, Effort::Exact, CORRECTED);
        pipeline.score().unwrap();
        let told = |source: u64, number: u64, person: u32| Observation { source, ..observation(number, person) };
        let (mut invented, mut own) = (0, 0);
        for _ in 0..20 {
            let of_invented: Vec<_> =
                (0..6).map(|n| told(9, invented + n + 1, 2 + (invented + n) as u32 % 60)).collect();
            invented += 6;
            pipeline.observe(of_invented);
            pipeline.score_within(1).unwrap();
            own += 1;
            pipeline.observe([told(5, own, 1)]);
            for _ in 0..2 {
                pipeline.score_within(1).unwrap();
                assert_eq!(pipeline.scores().asked, 1);
            }
            assert!(!pipeline.waits(1) && pipeline.is_behind());
            let claim = |source: u64| pipeline.scores().included.iter().find(|known| known.source == source);
            assert_eq!(claim(5).map(|claim| claim.sequence), Some(own));
            assert!(claim(9).is_some_and(|claim| claim.sequence < invented));
        }
        // No flood ends the others' turns: who was told of is scored, and confirmed.
        while pipeline.is_behind() {
            pipeline.score_within(1).unwrap();
        }
        assert!(pipeline.scores().included.iter().any(|claim| (claim.source, claim.sequence) == (9, invented)));
    }

    fn preparer<M: LanguageModel>(pipeline: &Pipeline<M>) -> Preparer<M> {
        pipeline.preparer(Arc::new(|| false)).unwrap().unwrap()
    }

    /// The answer to what a person may do next, if they may.
    fn guessed<M: LanguageModel>(
        pipeline: &mut Pipeline<M>,
        preparer: &mut Preparer<M>,
        person: u32,
        guess: &Sentence,
    ) -> Option<Answer> {
        let outlook = pipeline.outlook();
        let ask = preparer.ask(&outlook, person, guess)?;
        Some(preparer.answer(ask).unwrap())
    }

    fn observation(sequence: u64, person: u32) -> Observation {
        let sentence = Sentence::new(&format!("They touch thing {sequence}.")).unwrap();
        Observation { person, ..Observation::of(sequence, sentence) }
    }

    /// A pipeline whose map lost an item scores as one that never had it: what is gone competes with nothing.
    #[test]
    fn a_changed_map_is_scored_as_a_fresh_one() {
        let before = SemanticMap::from_json(TWO_ROOMS).unwrap();
        for correction in [CorrectionChoice::EQUATION_1, CORRECTED] {
            for item in &before.items {
                let gone = MapChange::RemoveItem { id: item.id.clone() };
                let after = before.changed(vec![gone]).unwrap();
                let mut changed = pipeline(&before, Effort::Exact, correction);
                changed.step([observation(1, 0)]).unwrap();
                changed.change_map(&after, &GroundingOptions::default()).unwrap();
                changed.score().unwrap();
                let mut fresh = pipeline(&after, Effort::Exact, correction);
                fresh.step([observation(1, 0)]).unwrap();
                let scores = |of: &Pipeline<TableModel>| of.scores().grounded.partition_log_score_nats.clone();
                for (a, b) in scores(&changed).iter().zip(scores(&fresh)) {
                    assert!((a - b).abs() < 1e-9, "without {}: {a} {b}", item.id);
                }
            }
        }
    }

    proptest! {
        /// Whatever was prepared, also before something else came between, and whether it is what comes: the scores are those of a pipeline
        /// that prepares nothing.
        #[test]
        fn prepared_scores_are_those_computed_afterwards(
            acts in proptest::collection::vec((0_u32..3, 0_u64..4, 0_u32..4, 0_u64..4, 0_u8..9, any::<bool>()), 1..40)
        ) {
            let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
            let fewer = map.changed(vec![MapChange::RemoveItem { id: map.items[0].id.clone() }]).unwrap();
            for correction in [CorrectionChoice::EQUATION_1, CORRECTED] {
                let fresh = || pipeline_of(WholePrompt(TableModel::new(7)), &map, Effort::Exact, correction);
                let (mut ahead, mut behind) = (fresh(), fresh());
                let mut aside = preparer(&ahead);
                ahead.score().unwrap();
                behind.score().unwrap();
                let (mut used, mut is_whole) = (0, true);
                for &(person, does, of, guess, event, is_late) in &acts {
                    let guess = Sentence::new(&format!("They touch thing {guess}.")).unwrap();
                    let mut answer = guessed(&mut ahead, &mut aside, of, &guess);
                    prop_assert!(answer.is_none() || ahead.person(of).is_some());
                    let mut keep = |ahead: &mut Pipeline<_>| answer.take().map(|answer| ahead.keep_answer(answer));
                    if !is_late {
                        keep(&mut ahead);
                    }
                    match event {
                        0 => {
                            is_whole = !is_whole;
                            let map = if is_whole { &map } else { &fewer };
                            ahead.change_map(map, &GroundingOptions::default()).unwrap();
                            behind.change_map(map, &GroundingOptions::default()).unwrap();
                        }
                        1 => while ahead.tidy() | behind.tidy() {},
                        2 => {
                            ahead.end_window(person);
                            behind.end_window(person);
                        }
                        3 => drop(ahead.outlook()),
                        4 => {
                            ahead.forget_person(person);
                            behind.forget_person(person);
                        }
                        _ => {}
                    }
                    keep(&mut ahead);
                    used += ahead.step([observation(does, person)]).unwrap().prepared;
                    behind.step([observation(does, person)]).unwrap();
                    let pairs = [
                        (&ahead.scores().label_log_prob_nats, &behind.scores().label_log_prob_nats),
                        (&ahead.scores().grounded.partition_probability, &behind.scores().grounded.partition_probability),
                    ];
                    for (ahead, behind) in pairs {
                        prop_assert_eq!(ahead.len(), behind.len());
                        prop_assert!(ahead.iter().zip(behind).all(|(a, b)| a == b || (a - b).abs() < 1e-9), "{ahead:?} {behind:?}");
                    }
                    for label in 0..ahead.grounding().scored_labels().len() {
                        prop_assert_eq!(ahead.token_log_prob_nats(label), behind.token_log_prob_nats(label));
                    }
                }
                prop_assert!(used <= acts.len());
            }
        }
    }

    /// Whose prompt was read last is not always whose scores there are.
    #[test]
    fn tokens_of_somebody_who_is_forgotten_explain_nobody_else() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let mut both = pipeline(&map, Effort::Exact, CORRECTED);
        both.step([observation(1, 0), observation(2, 1)]).unwrap();
        both.forget_person(1);
        both.score().unwrap();
        assert!(both.token_log_prob_nats(0).is_none());
        both.step([observation(3, 0)]).unwrap();
        assert!(both.token_log_prob_nats(0).is_some());
    }

    #[test]
    fn what_was_guessed_is_answered_without_the_model() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let mut ahead = pipeline(&map, Effort::Exact, CORRECTED);
        let mut aside = preparer(&ahead);
        ahead.step([observation(1, 0)]).unwrap();
        let said = observation(2, 0);
        let guess = Sentence::new(said.sentence().unwrap()).unwrap();
        let answer = guessed(&mut ahead, &mut aside, 0, &guess).unwrap();
        assert!(ahead.keep_answer(answer));
        assert!(guessed(&mut ahead, &mut aside, 9, &guess).is_none(), "nobody knows them");
        let stale = guessed(&mut ahead, &mut aside, 0, &guess).unwrap();
        let scores = ahead.step([said.clone()]).unwrap();
        assert_eq!((scores.asked, scores.prepared, scores.stats.calls), (1, 1, 0));
        assert!(!ahead.keep_answer(stale), "they have done something since");
        // Forgetting leaves nothing of it, nor of what is on its way.
        let answer = guessed(&mut ahead, &mut aside, 0, &guess).unwrap();
        assert!(ahead.keep_answer(answer));
        let late = guessed(&mut ahead, &mut aside, 0, &guess).unwrap();
        ahead.forget_person(0);
        assert!(!ahead.keep_answer(late));
        ahead.step([said]).unwrap();
        assert_eq!(ahead.scores().prepared, 0);
    }

    #[test]
    fn only_exact_answers_are_prepared_and_so_many() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let partial = pipeline(&map, Effort::Top, CORRECTED);
        assert!(partial.preparer(Arc::new(|| false)).unwrap().is_none());
        let mut ahead = pipeline(&map, Effort::Exact, CORRECTED);
        let mut aside = preparer(&ahead);
        ahead.step([observation(1, 0)]).unwrap();
        let most = crate::prepared::ANSWERS_MAX as u64;
        for thing in 2..most + 4 {
            let guess = Sentence::new(&format!("They touch thing {thing}.")).unwrap();
            let answer = guessed(&mut ahead, &mut aside, 0, &guess).unwrap();
            assert_eq!(ahead.keep_answer(answer), thing < most + 2, "{thing}");
        }
    }

    /// A map of many labels leaves the histories fewer tokens; a smaller one gives them back.
    #[test]
    fn a_smaller_map_gives_the_history_its_tokens_back() {
        let small = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let things: Vec<String> = (0..40).map(|n| format!(r#"{{"change": "add-item", "item": {{"id": "thing-{n}", "label": "thing number {n}", "position_m": [1, 1, 1], "box": {{"min_m": [0.9, 0.9, 0.9], "max_m": [1.1, 1.1, 1.1]}}}}}}"#)).collect();
        let changes = crate::semantic_map::delta::parse_changes(&format!("[{}]", things.join(","))).unwrap();
        let large = small.changed(changes).unwrap();
        let grounding = Grounding::new(&small, &GroundingOptions::default()).unwrap();
        let model = TableModel::new(7);
        let history = HistoryLimits { tokens: model.info().context_tokens, ..HistoryLimits::default() };
        let mut pipeline = Pipeline::new(model, grounding, PipelineOptions { history, ..Default::default() }).unwrap();
        let before = pipeline.options().history.tokens;
        pipeline.change_map(&large, &GroundingOptions::default()).unwrap();
        assert!(pipeline.options().history.tokens < before);
        // A label that the large list does not know, so that the list is prepared again.
        let other = r#"[{"change": "add-item", "item": {"id": "lamp-1", "label": "lamp", "position_m": [1, 1, 1], "box": {"min_m": [0.9, 0.9, 0.9], "max_m": [1.1, 1.1, 1.1]}}}, {"change": "remove-item", "id": "wall-1"}]"#;
        let other = small.changed(crate::semantic_map::delta::parse_changes(other).unwrap()).unwrap();
        pipeline.change_map(&other, &GroundingOptions::default()).unwrap();
        let after = pipeline.options().history.tokens;
        assert!(after.abs_diff(before) < 20, "{before} tokens before, {after} after");
    }

    /// The bounds of two persons together hold under a prior, whose scale each person has for themselves.
    #[test]
    fn partial_answers_of_several_persons_are_true() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        for effort in [Effort::Ranking, Effort::Top, Effort::Deadline] {
            for correction in [CorrectionChoice::EQUATION_1, CORRECTED] {
                let (mut partial, mut exact) =
                    (pipeline(&map, effort, correction), pipeline(&map, Effort::Exact, correction));
                for sequence in 0..20 {
                    let next = observation(sequence, (sequence % 2) as u32);
                    partial.step([next.clone()]).unwrap();
                    exact.step([next]).unwrap();
                    let (partial, exact) = (partial.scores(), &exact.scores().grounded.partition_log_score_nats);
                    let bounds = partial.lower_log_score_nats.iter().zip(&partial.upper_log_score_nats);
                    for ((lower, upper), exact) in bounds.zip(exact) {
                        assert!(lower - 1e-9 <= *exact && *exact <= upper + 1e-9, "{lower} {exact} {upper}");
                    }
                    let order = |scores: &[f64]| scores[0] > scores[1];
                    if matches!(partial.reached, Effort::Ranking | Effort::Top) {
                        assert_eq!(order(&partial.grounded.partition_log_score_nats), order(exact));
                    }
                }
            }
        }
    }

    /// Who leaves less mass on the map is seen all the same, and their forecaster gets their own scores.
    #[test]
    fn persons_do_not_hide_each_other() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let mut both = pipeline(&map, Effort::Exact, CorrectionChoice::EQUATION_1);
        both.step([observation(1, 0), observation(2, 1)]).unwrap();
        let of = |person: u32| both.person(person).unwrap().grounded;
        let together = &both.scores().grounded;
        for room in 0..2 {
            let [p, q] = [0, 1].map(|person| of(person).partition_probability[room]);
            let anybody = 1.0 - (1.0 - p) * (1.0 - q);
            assert_eq!(together.partition_probability[room], anybody);
            assert!(anybody >= p.max(q) - 1e-15, "{anybody} {p} {q}");
            assert_eq!(together.partition_log_score_nats[room], anybody.ln());
        }
        assert_eq!(together.label_mass, (of(0).label_mass + of(1).label_mass) / 2.0);
        let mass: f64 = both.scores().label_log_prob_nats.iter().map(|nats| nats.exp()).sum();
        assert!((mass - together.label_mass).abs() < 1e-12);
    }

    fn presence(sequence: u64, person: u32, text: &str) -> Observation {
        Observation { said: Said::Presence(PresenceStatement::parse(text).unwrap()), ..observation(sequence, person) }
    }

    /// Who is out of the house is in no room and hides nobody; what they did before does not say what they do when they are back.
    #[test]
    fn who_is_away_is_in_no_room() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let fresh = || pipeline(&map, Effort::Exact, CORRECTED);
        let mut both = fresh();
        both.step([observation(1, 0), observation(2, 1)]).unwrap();
        both.step([presence(3, 0, "away")]).unwrap();
        let away = both.person(0).unwrap();
        assert!(!away.at_home && away.window == 0 && away.grounded.partition_probability == [0.0; 2]);
        assert_eq!(away.lower_log_score_nats, [f64::NEG_INFINITY; 2]);
        let mut alone = fresh();
        alone.step([observation(2, 1)]).unwrap();
        assert_eq!(both.scores().label_log_prob_nats, alone.scores().label_log_prob_nats);
        assert_eq!(both.scores().grounded.partition_probability, alone.scores().grounded.partition_probability);
        // Nobody is home: no room is likely.
        both.step([presence(4, 1, "away")]).unwrap();
        let nobody = both.scores();
        assert_eq!(nobody.grounded.partition_probability, [0.0; 2]);
        assert_eq!(nobody.grounded.partition_log_score_nats, [f64::NEG_INFINITY; 2]);
        assert!(nobody.grounded.label_mass == 0.0 && nobody.included.len() == 1 && nobody.included[0].sequence == 4);
        assert!(both.token_log_prob_nats(0).is_none());
        // Back: as nobody whom anything is known of.
        both.step([presence(5, 0, "present in the kitchen")]).unwrap();
        let unknown = fresh().score().unwrap().grounded.partition_probability.clone();
        assert_eq!(both.scores().grounded.partition_probability, unknown);
        both.step([presence(6, 1, "gone")]).unwrap();
        assert_eq!(both.persons().map(|own| own.person).collect::<Vec<_>>(), [0]);
    }

    /// Silence ends a window as a late observation does, and the person is scored once more.
    #[test]
    fn what_lies_hours_back_leaves_the_prompt() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let mut silent = pipeline(&map, Effort::Exact, CORRECTED);
        let mut unknown = pipeline(&map, Effort::Exact, CORRECTED);
        silent.step([observation(1, 0), observation(2, 0)]).unwrap();
        assert!(silent.end_window(0) && !silent.end_window(0) && !silent.end_window(1));
        silent.score().unwrap();
        unknown.score().unwrap();
        assert_eq!(silent.person(0).unwrap().window, 0);
        assert_eq!(silent.scores().grounded.partition_probability, unknown.scores().grounded.partition_probability);
        assert_eq!(silent.scores().stats.calls, 1, "one person was scored");
        silent.score().unwrap();
        assert_eq!(silent.scores().stats.calls, 0, "and once");
    }

    /// Scores of one person: labels, probabilities, scores and both bounds.
    fn values(scores: PersonScores) -> (Vec<u64>, Effort) {
        let GroundedScores { partition_log_score_nats, partition_probability, label_mass, .. } = scores.grounded;
        let all = [
            scores.label_log_prob_nats,
            partition_log_score_nats,
            partition_probability,
            scores.lower_log_score_nats,
            scores.upper_log_score_nats,
            &[*label_mass],
        ];
        (all.concat().iter().map(|value| value.to_bits()).collect(), scores.reached)
    }

    proptest! {
        /// What one narrator says, of whomever it invents too, changes nothing for persons that it does not speak of. Of the probability that
        /// anybody enters a room it moves what these leave of it, and no more: it can never make a room look free of them.
        #[test]
        fn a_narrator_moves_no_room_below_what_the_others_give_it(
            honest in prop::collection::vec(0u32..3, 1..12),
            other in prop::collection::vec((2u32..8, 0usize..12), 0..12),
            first in any::<bool>(),
        ) {
            let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
            let honest: Vec<_> = (1..).zip(&honest).map(|(number, person)| observation(number, *person)).collect();
            let said_by_other = |(number, &(person, what)): (u64, &(u32, usize))| {
                let said = match what {
                    0 => presence(number, person, "away"),
                    1 => presence(number, person, "present in the kitchen"),
                    _ => observation(number, person),
                };
                Observation { source: 99, ..said }
            };
            let others: Vec<_> = (1000..).zip(&other).map(said_by_other).collect();
            let mut with = pipeline(&map, Effort::Exact, CORRECTED);
            let mut without = pipeline(&map, Effort::Exact, CORRECTED);
            let (before, after) = if first { (&others, &honest) } else { (&honest, &others) };
            with.step(before.iter().chain(after).cloned()).unwrap();
            without.step(honest.iter().cloned()).unwrap();
            let spoken_of = |person: u32| other.iter().any(|(of, _)| *of == person);
            let mut free = [1.0; 2];
            for own in without.persons().filter(|own| !spoken_of(own.person)) {
                prop_assert_eq!(values(own), values(with.person(own.person).unwrap()));
                free.iter_mut().zip(&own.grounded.partition_probability).for_each(|(free, p)| *free *= 1.0 - p);
            }
            for (free, p) in free.iter().zip(&with.scores().grounded.partition_probability) {
                prop_assert!((1.0 - free) - 1e-12 <= *p && *p <= 1.0, "{p}, and the others alone give {}", 1.0 - free);
            }
        }

        /// However few persons a step scores, what it says is included is in the scores of everybody; after the last one the scores are those of
        /// a step without a bound.
        #[test]
        fn what_is_included_is_scored(
            said in prop::collection::vec((0u32..5, 0u64..3, 0usize..9, 0u64..4, any::<bool>()), 1..80),
        ) {
            let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
            let mut bounded = pipeline_of(TableModel::slow(7), &map, Effort::Exact, CORRECTED);
            let mut free = pipeline(&map, Effort::Exact, CORRECTED);
            bounded.score().unwrap();
            // Per narration its source, its number there, its person, and whether they were scored with it.
            let mut told: Vec<(u64, u64, u32, bool)> = Vec::new();
            for (number, &(person, source, what, steps, restarts)) in (1..).zip(&said) {
                let spoken = match what {
                    0 => presence(number, person, "away"),
                    1 => presence(number, person, "present"),
                    _ => observation(number, person),
                };
                let next = Observation { source, ..spoken };
                free.observe([next.clone()]);
                bounded.observe([next]);
                // Who is out waits for nothing, and what changes nothing does not either.
                told.push((source, number, person, !bounded.waits(person)));
                if restarts {
                    bounded.forget_voices();
                    free.forget_voices();
                }
                for _ in 0..steps {
                    let before = bounded.scores().included.clone();
                    bounded.score_within(1).unwrap();
                    prop_assert!(bounded.scores().asked <= 1);
                    told.iter_mut().for_each(|own| own.3 |= !bounded.waits(own.2));
                    for claim in &bounded.scores().included {
                        let all = told.iter().filter(|own| own.0 == claim.source && own.1 <= claim.sequence);
                        prop_assert!(all.clone().all(|own| own.3), "{claim:?}");
                        prop_assert_eq!(all.count() as u64, claim.accepted);
                        let earlier = before.iter().find(|earlier| earlier.source == claim.source);
                        prop_assert!(earlier.is_none_or(|earlier| earlier.sequence <= claim.sequence));
                    }
                }
            }
            while bounded.is_behind() {
                bounded.score_within(1).unwrap();
            }
            bounded.score().unwrap();
            free.score().unwrap();
            let newest = |pipeline: &Scores| {
                let of = |claim: &Included| (claim.source, claim.sequence, claim.accepted, claim.observed_ns);
                pipeline.included.iter().map(of).collect::<std::collections::BTreeSet<_>>()
            };
            prop_assert_eq!(newest(bounded.scores()), newest(free.scores()));
            prop_assert_eq!(bounded.scores().newest_observed_ns, free.scores().newest_observed_ns);
            prop_assert_eq!(&bounded.scores().grounded.partition_probability, &free.scores().grounded.partition_probability);
            for own in free.persons() {
                prop_assert_eq!(values(own), values(bounded.person(own.person).unwrap()));
            }
        }

        /// A person's scores are those that they have alone, to the bit; one person's are those of all together.
        #[test]
        fn a_persons_scores_are_those_of_that_person_alone(
            steps in prop::collection::vec((0u64..4000, prop::collection::vec((0u32..4, 0usize..12), 0..4)), 1..8),
            effort in prop::sample::select(vec![Effort::Exact, Effort::Ranking, Effort::Top]),
            corrected: bool,
            gone in prop::option::of(0usize..4),
        ) {
            let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
            let correction = if corrected { CORRECTED } else { CorrectionChoice::EQUATION_1 };
            let gone = gone.and_then(|item| map.items.get(item));
            let after = gone.map(|item| map.changed(vec![MapChange::RemoveItem { id: item.id.clone() }]).unwrap());
            let mut together = pipeline(&map, effort, correction);
            let mut alone = BTreeMap::<u32, Pipeline<TableModel>>::new();
            let (mut sequence, mut at_s) = (0, 1);
            for (number, (pause_s, persons)) in steps.iter().enumerate() {
                at_s += pause_s;
                let said: Vec<_> = persons.iter().map(|&(person, what)| {
                    sequence += 1;
                    let said = match what {
                        0 => presence(sequence, person, "away"),
                        1 => presence(sequence, person, "present"),
                        2 => presence(sequence, person, "present in the kitchen"),
                        3 => presence(sequence, person, "gone"),
                        _ => observation(sequence, person),
                    };
                    Observation { observed_ns: at_s * 1_000_000_000, ..said }
                }).collect();
                // Silence ends a window.
                if *pause_s % 5 == 0 {
                    together.end_window(2);
                    if let Some(own) = alone.get_mut(&2) {
                        own.end_window(2);
                        own.score().unwrap();
                    }
                }
                together.step(said.clone()).unwrap();
                for person in said.iter().map(|o| o.person).collect::<std::collections::BTreeSet<_>>() {
                    let own = alone.entry(person).or_insert_with(|| pipeline(&map, effort, correction));
                    own.step(said.iter().filter(|o| o.person == person).cloned()).unwrap();
                }
                if number + 1 == steps.len() && let Some(after) = &after {
                    together.change_map(after, &GroundingOptions::default()).unwrap();
                    prop_assert!(together.persons().next().is_none(), "scores of the old map");
                    together.score().unwrap();
                    for own in alone.values_mut() {
                        own.change_map(after, &GroundingOptions::default()).unwrap();
                        own.score().unwrap();
                    }
                }
            }
            alone.retain(|_, own| own.persons().next().is_some());
            prop_assert_eq!(together.persons().count(), alone.len());
            for (person, own) in &alone {
                let own_scores = values(own.person(*person).unwrap());
                prop_assert_eq!(values(together.person(*person).unwrap()), own_scores.clone());
                let Scores { label_log_prob_nats, grounded, reached, .. } = own.scores();
                let (lower_log_score_nats, upper_log_score_nats) =
                    (&own.scores().lower_log_score_nats[..], &own.scores().upper_log_score_nats[..]);
                let all = PersonScores {
                    person: *person,
                    at_home: true,
                    window: 0,
                    is_current: true,
                    number: 0,
                    label_log_prob_nats,
                    grounded,
                    reached: *reached,
                    lower_log_score_nats,
                    upper_log_score_nats,
                };
                prop_assert_eq!(values(all), own_scores);
            }
        }
    }
}
