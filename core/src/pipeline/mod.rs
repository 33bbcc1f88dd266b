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

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::grounding::{GroundedScores, Grounding, GroundingError, GroundingOptions, Regrouped};
use crate::ids::{EventId, PersonId};
use crate::narration::history::{Histories, History, HistoryLimits, Voice};
use crate::narration::{Observation, Presence};
use crate::prepared::{Answer, Outlook, PersonOutlook, PreparedAnswers, Preparer};
use crate::prompt::BindingSequence;
use crate::scorer::certified::{Certified, Effort};
use crate::scorer::correction::{Correction, CorrectionChoice};
use crate::scorer::{
    DecodeStats, IsStopped, LanguageModel, Method, ModelError, ModelInfo, PreparedLabels, Progress, ScoreError, Scorer,
    TextStart, TokenCounter, Tokenisation,
};
use crate::semantic_map::SemanticMap;

use heard::Sources;
use person::{Due, Person, Unscored};
use scores::together;

mod heard;
mod person;
mod scores;
#[cfg(test)]
mod tests;

pub use heard::SOURCES_MAX;
pub use scores::{Included, PersonScores, Scores, Timing};

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

/// What a changed map asked of the model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Prepared {
    /// Whether it was prepared for the map's labels again.
    pub again: bool,
    /// How many of them are new.
    pub new_labels: usize,
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
    read: Option<PersonId>,
    /// The model has not read all of their narration: the scores were ready, or the window was cut.
    is_unread: bool,
    /// How often persons' scores were grounded.
    groundings: u64,
    heard: Sources,
    /// Tokens that the model was given for each voice whose persons wait, and where the one stood that was served last.
    given: BTreeMap<u64, u64>,
    given_last: u64,
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
            groundings: 0,
            heard: Sources::default(),
            given: BTreeMap::new(),
            given_last: 0,
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

    /// Takes a changed map. The model is prepared again if the map brings a label that the model was not prepared for. It is prepared again, too,
    /// if labels are gone and scores are corrected, or the labels leave the histories fewer tokens than was asked for. Otherwise the next
    /// [`Pipeline::score`] sums the known label scores again.
    ///
    /// Partial answers ([`PipelineOptions::effort`]) know their labels only as far as the old map asked; they are scored again.
    ///
    /// # Errors
    /// When the map cannot be grounded, its labels leave no room for narration, or the model fails; the old map stays in use then.
    pub fn change_map(&mut self, map: &SemanticMap, options: &GroundingOptions) -> Result<Prepared, PipelineError> {
        let Regrouped { grounding, new_labels } = self.grounding.regroup(map, options)?;
        // Corrected scores depend on the labels that there are.
        let is_corrected = self.prepared.correction() != Correction::default();
        let is_narrow = self.options.history.tokens < self.history_tokens;
        let again = new_labels > 0 || grounding.has_idle_labels() && (is_corrected || is_narrow);
        let prepared = Prepared { again, new_labels };
        if !again {
            self.grounding = grounding;
        } else {
            // The list is prepared again, so labels that nothing bears any more can leave it.
            let grounding = Grounding::new(map, options)?;
            let (labels, tokens) = prepare(&mut self.scorer, &grounding, &self.options, self.history_tokens)?;
            self.options.history.tokens = tokens;
            self.histories.limit_tokens(tokens);
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
    pub fn read_sentences(&self) -> impl Iterator<Item = (PersonId, &str)> {
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
        self.persons.iter().filter(|person| person.is_scored()).map(PersonScores::of)
    }

    /// One person's own scores, if they have any.
    #[must_use]
    pub fn person(&self, person: PersonId) -> Option<PersonScores<'_>> {
        self.persons().find(|scores| scores.person == person)
    }

    /// Whether the model has to be asked about a person: their scores are of what they did before, or there are none yet.
    #[must_use]
    pub fn waits(&self, person: PersonId) -> bool {
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
    pub fn prior_nats_of_person(&self, person: PersonId, label: usize) -> f64 {
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
                self.pass_over(observation.id());
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
        let (person, presence) = (observation.person, observation.event.person_presence());
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
            self.persons.insert(
                place,
                Person { waits_from: self.heard.turns(), waits_until: self.heard.turns(), ..Person::new(person) },
            );
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
                own.wait_from(self.heard.turns());
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
    pub fn end_window(&mut self, person: PersonId) -> bool {
        let ended = self.histories.get_mut(person).is_some_and(|history| history.end() > 0);
        if let Some(own) = self.persons.iter_mut().find(|own| ended && own.id == person) {
            own.wait_from(self.heard.turns());
        }
        ended
    }

    /// Takes note that a narration was dealt with and is in no history, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, event: EventId) {
        self.heard.pass_over(event);
    }

    /// Takes note of an observation that the next scores contain, of however many persons it is, also of none.
    pub fn include(&mut self, observation: &Observation, voice: Voice) {
        self.heard.include(observation, voice);
    }

    /// Takes note up to which sequence a former run has dealt with the starts of sources. Which of it was accepted nobody can say any more, so
    /// all of it counts as accepted.
    pub fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.heard.settle(settled);
    }

    /// Forgets a start of a source, which gave way to another one.
    pub fn forget_source(&mut self, source: u64, epoch: u64) {
        self.heard.forget(source, epoch);
    }

    /// Forgets a person, for instance one who has left the map.
    pub fn forget_person(&mut self, person: PersonId) {
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
        let turn = self.heard.turns();
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
            let mut nobody = std::mem::replace(&mut self.nobody, Person::new(PersonId(0)));
            let asked = if nobody.waits() { self.ask(&mut nobody, start, &mut timing) } else { Ok(()) };
            self.nobody = nobody;
            asked?;
        }
        while let Some((place, voice)) = self.next_person() {
            if self.scores.asked > 0 && now().saturating_sub(start) >= patience_ns {
                break;
            }
            let before = self.scores.stats;
            let mut person = std::mem::replace(&mut self.persons[place], Person::new(PersonId(0)));
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
        self.heard.tell(&self.persons, &mut self.scores);
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
        let of = |(person, history): (PersonId, &History)| {
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

/// The map's labels ready to be scored, and how many tokens narration may have: at most `history_tokens`, and what the labels and the binding
/// sequence leave of the model's context. The model takes memory for these alone.
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
    scorer.reserve(needed + tokens)?;
    scorer.learn_prior(&mut prepared)?;
    Ok((prepared, tokens))
}
