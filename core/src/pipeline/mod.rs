//! One step of the flow: observations in, scores of labels, items and partitions out.
//!
//! Every person is scored and grounded independently. The combined score of a partition is the probability that at least one person is there next:
//! `1 - prod over persons (1 - p)`, which is `p` for one person.
//!
//! A person out of the house is in no partition: their probabilities are 0, and they do not affect the others' scores. After they return,
//! their earlier events are not used.
//!
//! If many persons' windows have changed, each call of [`Pipeline::score_within`] asks the model about some of them. A waiting person keeps the
//! scores of the previous window. An event counts as included only after every person it is about has been scored with it.
//!
//! The pipeline owns every buffer and does no I/O; the daemon, `roomcast score`, the experiments and the replay all use it.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::grounding::{GroundedScores, Grounding, GroundingError, GroundingOptions, Regrouped};
use crate::ids::PersonId;
use crate::narration::history::{Histories, HistoryLimits, Quota};
use crate::narration::{Observation, Presence};
use crate::prepared::PreparedAnswers;
use crate::prompt::BindingSequence;
use crate::scorer::certified::{Certified, Effort};
use crate::scorer::correction::{Correction, CorrectionChoice};
use crate::scorer::{DecodeStats, LanguageModel, Method, PreparedLabels, ScoreError, Scorer, TextStart, Tokenisation};
use crate::semantic_map::SemanticMap;

use heard::Sources;
use person::{Due, Person, Unscored};
use scores::together;

mod heard;
mod idle;
mod inside;
mod intake;
mod person;
mod scores;
#[cfg(test)]
mod tests;

pub use heard::SOURCES_MAX;
pub use idle::Idle;
pub use inside::Inside;
pub use intake::Intake;
pub use scores::{Included, PersonScores, Scores, Timing};

/// A pipeline that cannot be set up, or a step that failed. Histories stay complete.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The scorer failed.
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// The scores cannot be grounded.
    #[error(transparent)]
    Grounding(#[from] GroundingError),
    /// The model's context has no room for narration.
    #[error(
        "the context of {context} tokens leaves none for narration: the labels and the binding sequence need {needed}; raise model.context_tokens or use another model"
    )]
    ContextTooSmall {
        /// Tokens of the context.
        context: usize,
        /// Tokens needed for labels and binding sequence.
        needed: usize,
    },
}

/// Options of a pipeline.
#[derive(Debug, Clone, PartialEq)]
pub struct PipelineOptions {
    /// The binding sequence.
    pub binding: BindingSequence,
    /// How prompt and labels are cut into tokens.
    pub tokenisation: Tokenisation,
    /// How scores are corrected; unset fields follow the model file.
    pub correction: CorrectionChoice,
    /// How labels are scored.
    pub method: Method,
    /// How exact an answer is, under [`Method::Trie`]; the other methods are always exact.
    pub effort: Effort,
    /// Time limit of a step under [`Effort::Deadline`], from its start, in nanoseconds. If the model takes longer for the prompt alone, a step keeps
    /// the last scores ([`Scores::is_cut`]), and the next step scores.
    pub deadline_ns: u64,
    /// Limits of each person's window.
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

/// Result of a change of the map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Prepared {
    /// Whether the model was prepared again for the map's labels.
    pub again: bool,
    /// Number of new labels.
    pub new_labels: usize,
}

/// The flow from observations to scores. See the [module's documentation](self).
#[derive(Debug)]
pub struct Pipeline<M> {
    scorer: Scorer<M>,
    prepared: Arc<PreparedLabels>,
    grounding: Grounding,
    options: PipelineOptions,
    /// The configured limit of tokens per history; a map's labels may leave fewer.
    history_tokens: usize,
    histories: Histories,
    /// Sorted by id, so that sums do not depend on the order of arrival.
    persons: Vec<Person>,
    /// Placeholder before the first person is observed.
    nobody: Person,
    prompt: String,
    /// The person whose prompt was scored last.
    read: Option<PersonId>,
    /// The model has not decoded all of that person's narration, because the answer was prefetched.
    is_unread: bool,
    /// Duration of the last decoder call with a prompt.
    prompt_ns: u64,
    /// Number of groundings so far; numbers the persons' scores.
    groundings: u64,
    heard: Sources,
    /// Tokens decoded per quota with waiting persons, and the count of the quota that was served last.
    given: BTreeMap<u64, u64>,
    given_last: u64,
    answers: PreparedAnswers,
    scores: Scores,
}

impl<M: LanguageModel> Pipeline<M> {
    /// A pipeline for a map, with default options.
    ///
    /// # Errors
    /// As [`Pipeline::new`], and if the map cannot be grounded.
    pub fn of(map: &SemanticMap, model: M) -> Result<Self, PipelineError> {
        Self::new(model, Grounding::new(map, &GroundingOptions::default())?, PipelineOptions::default())
    }

    /// Cuts the map's labels into tokens, builds their trie and computes the prior's gains, once.
    ///
    /// # Errors
    /// If a label has no tokens, the model's context leaves no room for narration, or the model fails on a blank narration.
    pub fn new(model: M, grounding: Grounding, mut options: PipelineOptions) -> Result<Self, PipelineError> {
        let mut scorer = Scorer::new(model);
        let history_tokens = options.history.tokens;
        let (prepared, tokens) = prepare(&mut scorer, &grounding, &options, history_tokens)?;
        options.history.tokens = tokens;
        let histories = Histories::new(options.history);
        Ok(Self {
            scorer,
            prepared: Arc::new(prepared),
            grounding,
            options,
            history_tokens,
            histories,
            persons: Vec::new(),
            nobody: Person::new(PersonId(0)),
            prompt: String::new(),
            read: None,
            is_unread: false,
            prompt_ns: 0,
            groundings: 0,
            heard: Sources::default(),
            given: BTreeMap::new(),
            given_last: 0,
            answers: PreparedAnswers::default(),
            scores: Scores::default(),
        })
    }

    /// The map's labels and partitions.
    pub fn grounding(&self) -> &Grounding {
        &self.grounding
    }

    /// Adds observations without scoring, and removes them.
    pub fn intake(&mut self) -> Intake<'_, M> {
        Intake(self)
    }

    /// Prefetching and idle-time work.
    pub fn idle(&mut self) -> Idle<'_, M> {
        Idle(self)
    }

    /// Read access to the pipeline's parts.
    pub fn inside(&self) -> Inside<'_, M> {
        Inside(self)
    }

    /// Switches to a changed map. The labels are prepared again in three cases: the map has a new label; labels are gone and scores are corrected;
    /// labels are gone and the histories have fewer tokens than configured. Otherwise the next [`Pipeline::score`] only grounds the known label
    /// scores again.
    ///
    /// Partial answers ([`PipelineOptions::effort`]) are scored again, because they are exact only where the old map needed it.
    ///
    /// # Errors
    /// If the map cannot be grounded, its labels leave no room for narration, or the model fails; the old map stays in use then.
    pub fn change_map(&mut self, map: &SemanticMap, options: &GroundingOptions) -> Result<Prepared, PipelineError> {
        let Regrouped { grounding, new_labels } = self.grounding.regroup(map, options)?;
        // Corrected scores depend on the set of labels.
        let is_corrected = self.prepared.correction() != Correction::default();
        let is_narrow = self.options.history.tokens < self.history_tokens;
        let again = new_labels > 0 || grounding.has_idle_labels() && (is_corrected || is_narrow);
        let prepared = Prepared { again, new_labels };
        if !again {
            self.grounding = grounding;
        } else {
            // A fresh grounding drops labels without an item.
            let grounding = Grounding::new(map, options)?;
            let (labels, tokens) = prepare(&mut self.scorer, &grounding, &self.options, self.history_tokens)?;
            self.options.history.tokens = tokens;
            self.histories.limit_tokens(tokens);
            self.prepared = Arc::new(labels);
            self.grounding = grounding;
            self.answers.clear();
            // These scores follow the old list's order.
            self.scores.label_log_prob_nats.clear();
        }
        let exact = self.options.method != Method::Trie || self.options.effort == Effort::Exact;
        let due = if again || !exact { Due::Scoring } else { Due::Grounding };
        for person in self.persons.iter_mut().chain([&mut self.nobody]) {
            // It holds the old map's weights.
            person.certified = None;
            // These scores are those of the old map's partitions.
            person.grounded = GroundedScores::default();
            person.due = person.due.max(due);
            person.is_owed = true;
        }
        Ok(prepared)
    }

    /// The scores of the last step.
    pub fn scores(&self) -> &Scores {
        &self.scores
    }

    /// Each person's scores, sorted by person id. Persons without scores for the current map are left out.
    pub fn persons(&self) -> impl Iterator<Item = PersonScores<'_>> {
        self.persons.iter().filter(|person| person.is_scored()).map(PersonScores::of)
    }

    fn prior_nats_of(&self, person: &Person, label: usize) -> f64 {
        self.prepared.gain_nats().get(label).map_or(0.0, |gain_nats| gain_nats + person.scores.scale_nats)
    }

    fn enter_of(&mut self, quota: Quota, observation: Observation, tokens: Option<usize>) {
        let (person, presence) = (observation.person, observation.event.person_presence());
        let Observation { source, epoch, sequence, .. } = observation;
        if presence == Presence::Gone {
            self.intake().forget_person(person);
            return;
        }
        let at_home = presence != Presence::Away;
        let history = self.histories.known(person);
        let changed = match tokens {
            Some(tokens) => {
                history.hear(observation, quota, tokens);
                true
            }
            None => !at_home && history.end() > 0,
        };
        let place = self.persons.binary_search_by_key(&person, |known| known.id);
        let place = place.unwrap_or_else(|place| {
            self.persons.insert(
                place,
                Person { waits_from: self.heard.turns(), waits_until: self.heard.turns(), ..Person::new(person) },
            );
            place
        });
        let own = &mut self.persons[place];
        if own.at_home != at_home {
            // Invalid until the next step grounds the person again.
            own.grounded = GroundedScores::default();
        }
        if changed || own.at_home != at_home {
            own.at_home = at_home;
            if at_home {
                own.wait_from(self.heard.turns());
            } else {
                own.due = Due::Grounding;
            }
        }
        if own.due != Due::Nothing && !own.unscored.iter().any(|known| (known.source, known.epoch) == (source, epoch)) {
            own.unscored.push(Unscored { source, epoch, sequence, quota: quota.number });
        }
        self.persons.retain(|p| self.histories.get(p.id).is_some());
    }

    /// Scores the persons whose history changed since the last step, and grounds the result. Before the first observation, the binding sequence alone
    /// is scored.
    ///
    /// # Errors
    /// If the model fails. The histories stay, and the next step scores the remaining persons.
    pub fn score(&mut self) -> Result<&Scores, PipelineError> {
        self.score_within(u64::MAX)
    }

    /// As [`Pipeline::score`], but stops asking the model after `patience_ns`; the next call continues ([`Inside::is_behind`]). At least one waiting
    /// person is scored.
    ///
    /// The quota for which the model has decoded least comes next, and of its persons the one that has waited longest. So a narrator with many
    /// persons delays another narrator's person by at most one call: `patience_ns` and one prompt.
    ///
    /// # Errors
    /// As [`Pipeline::score`].
    pub fn score_within(&mut self, patience_ns: u64) -> Result<&Scores, PipelineError> {
        let now = self.scorer.model().clock();
        let start = now();
        let mut timing = Timing::default();
        self.scores.stats = DecodeStats::default();
        (self.scores.prompt_tokens, self.scores.asked, self.scores.prepared) = (0, 0, 0);
        self.scores.is_cut = self.is_cut();
        if self.persons.is_empty() {
            let mut nobody = std::mem::replace(&mut self.nobody, Person::new(PersonId(0)));
            let asked = if nobody.waits() { self.ask(&mut nobody, start, &mut timing) } else { Ok(()) };
            self.nobody = nobody;
            asked?;
        }
        while !self.scores.is_cut
            && let Some((place, quota)) = self.next_person()
        {
            if self.scores.asked > 0 && now().saturating_sub(start) >= patience_ns {
                break;
            }
            let before = self.scores.stats;
            let mut persons = std::mem::take(&mut self.persons);
            let asked = self.ask(&mut persons[place], start, &mut timing);
            self.persons = persons;
            asked?;
            let stats = self.scores.stats;
            let given = (stats.prompt_tokens_decoded - before.prompt_tokens_decoded)
                + (stats.tree_tokens_decoded - before.tree_tokens_decoded);
            self.given_last = self.given_of(quota);
            self.given.insert(quota, self.given_last + u64::from(given));
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
        self.heard.tell(&self.persons, &mut self.scores);
        let persons = &self.persons;
        self.given
            .retain(|quota, _| persons.iter().any(|own| own.waits() && own.quotas().any(|other| other == *quota)));
        timing.ground_ns = now().saturating_sub(grounding);
        timing.total_ns = now().saturating_sub(start);
        self.scores.timing = timing;
        Ok(&self.scores)
    }

    /// Whether the model cannot read a prompt within the deadline, and all waiting persons have earlier scores. Never twice in succession.
    fn is_cut(&self) -> bool {
        let PipelineOptions { effort, deadline_ns, .. } = self.options;
        let mut waiting = self.persons.iter().filter(|own| own.waits()).peekable();
        let is_late = effort == Effort::Deadline && self.prompt_ns > deadline_ns && !self.scores.is_cut;
        is_late && waiting.peek().is_some() && waiting.all(Person::is_scored)
    }

    /// Tokens decoded for a quota. A quota that was not waiting starts at the count of the quota that was served last.
    fn given_of(&self, quota: u64) -> u64 {
        self.given.get(&quota).copied().unwrap_or(self.given_last)
    }

    /// The next person to score (index), and the quota it is scored for.
    fn next_person(&self) -> Option<(usize, u64)> {
        let waiting = self.persons.iter().enumerate().filter(|(_, own)| own.waits());
        let ways = waiting.flat_map(|(place, own)| own.quotas().map(move |quota| (place, quota)));
        ways.min_by_key(|(place, quota)| (self.given_of(*quota), self.persons[*place].waits_from, *place))
    }

    /// Scores one person, in a step that began at `start` (nanoseconds).
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
        self.prompt_ns = person.scores.prefix_ns;
        timing.tokenise_ns += person.scores.tokenise_ns;
        timing.prefix_ns += person.scores.prefix_ns;
        timing.trie_ns += person.scores.trie_ns;
        self.scores.prompt_tokens += person.scores.prompt_tokens;
        self.scores.stats += person.scores.stats;
        Ok(())
    }

    /// Prefetching needs exact answers by the trie.
    fn keeps_answers(&self) -> bool {
        self.options.method == Method::Trie && self.options.effort == Effort::Exact
    }

    /// Adds observations, then scores.
    ///
    /// # Errors
    /// As [`Pipeline::score`]; the histories contain the observations even then.
    pub fn step(&mut self, observations: impl IntoIterator<Item = Observation>) -> Result<&Scores, PipelineError> {
        self.intake().observe(observations);
        self.score()
    }
}

/// Tokens of a sentence with its separator, for the memory of a usual window. The shipped programs need 8 on average, and 11 at most.
const SENTENCE_TOKENS: usize = 12;

/// Prepares the map's labels and returns them with the token limit of narration: `history_tokens`, or less if the labels and the binding sequence
/// leave less of the model's context.
///
/// This is the bound of the model's memory: narration, binding sequence and labels. A window of usual sentences is allocated now; for longer ones
/// the model allocates more, up to the bound ([`LanguageModel::reserve`]).
fn prepare<M: LanguageModel>(
    scorer: &mut Scorer<M>,
    grounding: &Grounding,
    options: &PipelineOptions,
    history_tokens: usize,
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
    let tokens = history_tokens.min(context - needed);
    let HistoryLimits { observations, slack, .. } = options.history;
    let usual = observations.saturating_add(slack).saturating_add(1).saturating_mul(SENTENCE_TOKENS);
    scorer.reserve(needed + tokens.min(usual))?;
    scorer.learn_prior(&mut prepared)?;
    Ok((prepared, tokens))
}
