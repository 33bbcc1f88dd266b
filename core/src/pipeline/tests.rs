use std::sync::atomic::{AtomicUsize, Ordering};

use proptest::prelude::*;

use super::*;
use crate::ids::{BootNs, PersonId};
use crate::label_trie::TokenTree;
use crate::narration::{Event, Sentence};
use crate::prepared::{Answer, Preparer};
use crate::scorer::correction::Continuation;
use crate::scorer::table::TableModel;
use crate::scorer::{IsStopped, ModelError, ModelInfo, Token};
use crate::semantic_map::delta::MapChange;

const TWO_ROOMS: &str = include_str!("../../../tests/data/two_rooms.json");
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

/// A fake with rows that depend on the whole prompt; the table's depend on its last tokens only.
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

    fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError> {
        Ok(Some(Self(self.0.clone())))
    }
}

/// A fake that visits other rows than it is asked for, by its function.
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

    fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError> {
        Ok(None)
    }
}

/// A fake that records the last reservation in tokens.
struct Reserving(TableModel, Arc<AtomicUsize>);

impl LanguageModel for Reserving {
    fn info(&self) -> &ModelInfo {
        self.0.info()
    }

    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
        self.0.tokenise(text, start, out)
    }

    fn token_text(&self, token: Token) -> String {
        self.0.token_text(token)
    }

    fn reserve(&mut self, positions: usize) -> Result<(), ModelError> {
        self.1.store(positions, Ordering::Relaxed);
        Ok(())
    }

    fn decode(
        &mut self,
        prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError> {
        self.0.decode(prompt, tree, want_prompt_row, visit)
    }
}

#[test]
fn contexts_hold_the_window_the_binding_and_the_labels_and_no_more() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let grounding = |map: &SemanticMap| Grounding::new(map, &GroundingOptions::default()).unwrap();
    let asked = Arc::new(AtomicUsize::new(0));
    let model = || Reserving(TableModel::new(7), Arc::clone(&asked));
    let of = |tokens| {
        let history = HistoryLimits { tokens, ..HistoryLimits::default() };
        Pipeline::new(model(), grounding(&map), PipelineOptions { history, ..PipelineOptions::default() }).unwrap()
    };
    let beside =
        |pipeline: &Pipeline<Reserving>| asked.load(Ordering::Relaxed) - pipeline.inside().options().history.tokens;
    let (small, large) = (of(100), of(150));
    let labels = small.inside().prepared();
    let trees = labels.trie().inner().len() + labels.longest_label();
    drop(of(100));
    let needed = beside(&small);
    assert!(needed > trees && needed <= trees + 1 + BindingSequence::default().text().len() + 1, "{needed}, {trees}");
    drop(of(150));
    assert_eq!(beside(&large), needed, "the window grows the context by as much");
    // An unbounded window gets memory for usual sentences.
    drop(of(usize::MAX));
    assert_eq!(asked.load(Ordering::Relaxed), needed + 17 * SENTENCE_TOKENS);
    // A map with more labels needs more.
    let mut pipeline = of(100);
    let before = asked.load(Ordering::Relaxed);
    let things = [("washing machine", 1.0), ("washing basket", 1.2), ("washing line", 1.4)];
    let mut json: serde_json::Value = serde_json::from_str(TWO_ROOMS).unwrap();
    let items = json["items"].as_array_mut().unwrap();
    for (label, x) in things {
        let mut item = items[0].clone();
        item["id"] = label.into();
        item["label"] = label.into();
        item["position_m"][0] = x.into();
        items.push(item);
    }
    pipeline.change_map(&SemanticMap::from_json(&json.to_string()).unwrap(), &GroundingOptions::default()).unwrap();
    assert!(asked.load(Ordering::Relaxed) > before);
}

/// A faulty model causes an error, instead of wrong scores or no scores for ever.
#[test]
fn a_model_that_forgets_a_row_is_refused() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let wrong: [fn(usize) -> Option<usize>; 4] =
        [|_| None, |row| (row % 2 == 0).then_some(row), |row| (row != 0).then_some(row), |row| Some(row + 1)];
    for given in wrong {
        for effort in [Effort::Exact, Effort::Ranking, Effort::Top] {
            let correction = CorrectionChoice { prior: Some(0.0), ..CorrectionChoice::default() };
            let mut own = pipeline_of(Careless(TableModel::new(7), given), &map, effort, correction);
            own.intake().observe([observation(1, PersonId(1))]);
            let told = own.score().map(|_| ()).unwrap_err().to_string();
            assert!(told.contains("rows of logits"), "{told}");
        }
    }
}

/// A narrator with many persons, among them another narrator's, delays that narrator by one prompt at most.
#[test]
fn who_tells_of_many_persons_delays_nobody_elses() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let mut pipeline = pipeline_of(TableModel::slow(7), &map, Effort::Exact, CORRECTED);
    pipeline.score().unwrap();
    let told = |source: u64, number: u64, person: PersonId| Observation { source, ..observation(number, person) };
    let (mut invented, mut own) = (0, 0);
    for _ in 0..20 {
        let of_invented: Vec<_> =
            (0..6).map(|n| told(9, invented + n + 1, PersonId(2 + (invented + n) as u32 % 60))).collect();
        invented += 6;
        pipeline.intake().observe(of_invented);
        pipeline.score_within(1).unwrap();
        own += 1;
        pipeline.intake().observe([told(5, own, PersonId(1))]);
        for _ in 0..2 {
            pipeline.score_within(1).unwrap();
            assert_eq!(pipeline.scores().asked, 1);
        }
        assert!(!pipeline.inside().waits(PersonId(1)) && pipeline.inside().is_behind());
        let claim = |source: u64| pipeline.scores().included.iter().find(|known| known.source == source);
        assert_eq!(claim(5).map(|claim| claim.sequence), Some(own));
        assert!(claim(9).is_some_and(|claim| claim.sequence < invented));
    }
    // All persons are scored and confirmed in the end.
    while pipeline.inside().is_behind() {
        pipeline.score_within(1).unwrap();
    }
    assert!(pipeline.scores().included.iter().any(|claim| (claim.source, claim.sequence) == (9, invented)));
}

/// The limit is 5 ms, and this model takes 400 ms for a prompt.
#[test]
fn a_step_with_a_model_slower_than_the_deadline_keeps_the_last_scores_once() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let of = |effort| pipeline_of(TableModel::slow(7), &map, effort, CORRECTED);
    let (mut pipeline, mut exact) = (of(Effort::Deadline), of(Effort::Exact));
    // There are no earlier scores to keep.
    assert!(!pipeline.step([observation(1, PersonId(0))]).unwrap().is_cut);
    exact.step([observation(1, PersonId(0))]).unwrap();
    for sequence in 2..5 {
        let claim = |scores: &Scores| scores.included[0].sequence;
        let before = pipeline.scores().label_log_prob_nats.clone();
        let kept = pipeline.step([observation(sequence, PersonId(0))]).unwrap();
        assert!(kept.is_cut && kept.asked == 0 && kept.timing.total_ns == 0);
        assert_eq!((claim(kept), &kept.label_log_prob_nats), (sequence - 1, &before));
        assert!(pipeline.inside().is_behind());
        let scored = pipeline.score().unwrap();
        assert_eq!((scored.is_cut, scored.asked, claim(scored)), (false, 1, sequence));
        exact.step([observation(sequence, PersonId(0))]).unwrap();
        assert!(!exact.scores().is_cut);
    }
}

fn preparer<M: LanguageModel>(pipeline: &Pipeline<M>) -> Preparer<M> {
    pipeline.inside().preparer(Arc::new(|| false)).unwrap().unwrap()
}

/// Prefetches the answer to a person's possible next event, if there is an outlook for the person.
fn guessed<M: LanguageModel>(
    pipeline: &mut Pipeline<M>,
    preparer: &mut Preparer<M>,
    person: PersonId,
    guess: &Sentence,
) -> Option<Answer> {
    let outlook = pipeline.idle().outlook();
    let ask = preparer.ask(&outlook, person, guess)?;
    Some(preparer.answer(ask).unwrap())
}

fn observation(sequence: u64, person: PersonId) -> Observation {
    let sentence = Sentence::new(&format!("They touch thing {sequence}.")).unwrap();
    Observation { person, ..Observation::of(sequence, sentence) }
}

/// After an item was removed from the map, a pipeline scores like a fresh one: removed labels do not compete.
#[test]
fn a_changed_map_is_scored_as_a_fresh_one() {
    let before = SemanticMap::from_json(TWO_ROOMS).unwrap();
    for correction in [CorrectionChoice::EQUATION_1, CORRECTED] {
        for item in &before.items {
            let gone = MapChange::RemoveItem { id: item.id.clone() };
            let after = before.changed(vec![gone]).unwrap();
            let mut changed = pipeline(&before, Effort::Exact, correction);
            changed.step([observation(1, PersonId(0))]).unwrap();
            changed.change_map(&after, &GroundingOptions::default()).unwrap();
            changed.score().unwrap();
            let mut fresh = pipeline(&after, Effort::Exact, correction);
            fresh.step([observation(1, PersonId(0))]).unwrap();
            let scores = |of: &Pipeline<TableModel>| of.scores().grounded.partition_log_score_nats.clone();
            for (a, b) in scores(&changed).iter().zip(scores(&fresh)) {
                assert!((a - b).abs() < 1e-9, "without {}: {a} {b}", item.id);
            }
        }
    }
}

proptest! {
    /// Prefetching never changes scores, whether or not the guess comes true or other events come first.
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
                let mut answer = guessed(&mut ahead, &mut aside, PersonId(of), &guess);
                prop_assert!(answer.is_none() || ahead.inside().person(PersonId(of)).is_some());
                let mut keep = |ahead: &mut Pipeline<_>| answer.take().map(|answer| ahead.idle().keep_answer(answer));
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
                    1 => while ahead.idle().tidy() | behind.idle().tidy() {},
                    2 => {
                        ahead.intake().end_window(PersonId(person));
                        behind.intake().end_window(PersonId(person));
                    }
                    3 => drop(ahead.idle().outlook()),
                    4 => {
                        ahead.intake().forget_person(PersonId(person));
                        behind.intake().forget_person(PersonId(person));
                    }
                    _ => {}
                }
                keep(&mut ahead);
                used += ahead.step([observation(does, PersonId(person))]).unwrap().prepared;
                behind.step([observation(does, PersonId(person))]).unwrap();
                let pairs = [
                    (&ahead.scores().label_log_prob_nats, &behind.scores().label_log_prob_nats),
                    (&ahead.scores().grounded.partition_probability, &behind.scores().grounded.partition_probability),
                ];
                for (ahead, behind) in pairs {
                    prop_assert_eq!(ahead.len(), behind.len());
                    prop_assert!(ahead.iter().zip(behind).all(|(a, b)| a == b || (a - b).abs() < 1e-9), "{ahead:?} {behind:?}");
                }
                for label in 0..ahead.grounding().scored_labels().len() {
                    prop_assert_eq!(ahead.inside().token_log_prob_nats(label), behind.inside().token_log_prob_nats(label));
                }
            }
            prop_assert!(used <= acts.len());
        }
    }
}

/// The last prompt may belong to a forgotten person.
#[test]
fn tokens_of_somebody_who_is_forgotten_explain_nobody_else() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let mut both = pipeline(&map, Effort::Exact, CORRECTED);
    both.step([observation(1, PersonId(0)), observation(2, PersonId(1))]).unwrap();
    both.intake().forget_person(PersonId(1));
    both.score().unwrap();
    assert!(both.inside().token_log_prob_nats(0).is_none());
    both.step([observation(3, PersonId(0))]).unwrap();
    assert!(both.inside().token_log_prob_nats(0).is_some());
}

#[test]
fn what_was_guessed_is_answered_without_the_model() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let mut ahead = pipeline(&map, Effort::Exact, CORRECTED);
    let mut aside = preparer(&ahead);
    ahead.step([observation(1, PersonId(0))]).unwrap();
    let said = observation(2, PersonId(0));
    let guess = Sentence::new(said.sentence().unwrap()).unwrap();
    let answer = guessed(&mut ahead, &mut aside, PersonId(0), &guess).unwrap();
    assert!(ahead.idle().keep_answer(answer));
    assert!(guessed(&mut ahead, &mut aside, PersonId(9), &guess).is_none(), "nobody knows them");
    let stale = guessed(&mut ahead, &mut aside, PersonId(0), &guess).unwrap();
    let scores = ahead.step([said.clone()]).unwrap();
    assert_eq!((scores.asked, scores.prepared, scores.stats.calls), (1, 1, 0));
    assert!(!ahead.idle().keep_answer(stale), "they have done something since");
    // Forgetting a person drops stored answers, and answers that arrive later.
    let answer = guessed(&mut ahead, &mut aside, PersonId(0), &guess).unwrap();
    assert!(ahead.idle().keep_answer(answer));
    let late = guessed(&mut ahead, &mut aside, PersonId(0), &guess).unwrap();
    ahead.intake().forget_person(PersonId(0));
    assert!(!ahead.idle().keep_answer(late));
    ahead.step([said]).unwrap();
    assert_eq!(ahead.scores().prepared, 0);
}

#[test]
fn only_exact_answers_are_prepared_and_so_many() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let partial = pipeline(&map, Effort::Top, CORRECTED);
    assert!(partial.inside().preparer(Arc::new(|| false)).unwrap().is_none());
    let mut ahead = pipeline(&map, Effort::Exact, CORRECTED);
    let mut aside = preparer(&ahead);
    ahead.step([observation(1, PersonId(0))]).unwrap();
    let most = crate::prepared::ANSWERS_MAX as u64;
    for thing in 2..most + 4 {
        let guess = Sentence::new(&format!("They touch thing {thing}.")).unwrap();
        let answer = guessed(&mut ahead, &mut aside, PersonId(0), &guess).unwrap();
        assert_eq!(ahead.idle().keep_answer(answer), thing < most + 2, "{thing}");
    }
}

/// A map of many labels leaves the histories fewer tokens; a smaller map restores them.
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
    let before = pipeline.inside().options().history.tokens;
    pipeline.change_map(&large, &GroundingOptions::default()).unwrap();
    assert!(pipeline.inside().options().history.tokens < before);
    // Without a correction, idle labels change no score, but they still take tokens.
    assert!(pipeline.change_map(&small, &GroundingOptions::default()).unwrap().again);
    assert_eq!(pipeline.inside().options().history.tokens, before);
    assert!(!pipeline.change_map(&small, &GroundingOptions::default()).unwrap().again, "no label is idle");
    pipeline.change_map(&large, &GroundingOptions::default()).unwrap();
    // A label outside the large list, so that the list is prepared again.
    let other = r#"[{"change": "add-item", "item": {"id": "lamp-1", "label": "lamp", "position_m": [1, 1, 1], "box": {"min_m": [0.9, 0.9, 0.9], "max_m": [1.1, 1.1, 1.1]}}}, {"change": "remove-item", "id": "wall-1"}]"#;
    let other = small.changed(crate::semantic_map::delta::parse_changes(other).unwrap()).unwrap();
    pipeline.change_map(&other, &GroundingOptions::default()).unwrap();
    let after = pipeline.inside().options().history.tokens;
    assert!(after.abs_diff(before) < 20, "{before} tokens before, {after} after");
}

/// The bounds of two persons together hold under a prior with a scale per person.
#[test]
fn partial_answers_of_several_persons_are_true() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    for effort in [Effort::Ranking, Effort::Top, Effort::Deadline] {
        for correction in [CorrectionChoice::EQUATION_1, CORRECTED] {
            let (mut partial, mut exact) =
                (pipeline(&map, effort, correction), pipeline(&map, Effort::Exact, correction));
            for sequence in 0..20 {
                let next = observation(sequence, PersonId((sequence % 2) as u32));
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

/// A person with less mass on the map still counts, and each person has their own scores.
#[test]
fn persons_do_not_hide_each_other() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let mut both = pipeline(&map, Effort::Exact, CorrectionChoice::EQUATION_1);
    both.step([observation(1, PersonId(0)), observation(2, PersonId(1))]).unwrap();
    let of = |person: PersonId| both.inside().person(person).unwrap().grounded;
    let together = &both.scores().grounded;
    for room in 0..2 {
        let [p, q] = [0, 1].map(|person| of(PersonId(person)).partition_probability[room]);
        let anybody = 1.0 - (1.0 - p) * (1.0 - q);
        assert_eq!(together.partition_probability[room], anybody);
        assert!(anybody >= p.max(q) - 1e-15, "{anybody} {p} {q}");
        assert_eq!(together.partition_log_score_nats[room], anybody.ln());
    }
    assert_eq!(together.label_mass, (of(PersonId(0)).label_mass + of(PersonId(1)).label_mass) / 2.0);
    let mass: f64 = both.scores().label_log_prob_nats.iter().map(|nats| nats.exp()).sum();
    assert!((mass - together.label_mass).abs() < 1e-12);
}

#[test]
fn each_person_has_the_same_weight_in_the_scores_of_labels() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let model = WholePrompt(TableModel::new(7));
    let mut both = pipeline_of(model, &map, Effort::Exact, CorrectionChoice::EQUATION_1);
    both.step([observation(1, PersonId(0)), observation(2, PersonId(1))]).unwrap();
    let own = [0, 1].map(|person| both.inside().person(PersonId(person)).unwrap());
    let mass = own.map(|own| own.grounded.label_mass);
    assert_ne!(mass[0], mass[1]);
    for (label, nats) in both.scores().label_log_prob_nats.iter().enumerate() {
        let share = |own: PersonScores| own.label_log_prob_nats[label].exp() / own.grounded.label_mass;
        let expected = (mass[0] + mass[1]) / 2.0 * (share(own[0]) + share(own[1])) / 2.0;
        assert!((nats - expected.ln()).abs() < 1e-9, "{label}: {nats} {expected}");
    }
}

fn presence(sequence: u64, person: PersonId, text: &str) -> Observation {
    Observation { event: Event::presence(text).unwrap(), ..observation(sequence, person) }
}

/// A long silence ends a window, and the person is scored once more.
#[test]
fn what_lies_hours_back_leaves_the_prompt() {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let mut silent = pipeline(&map, Effort::Exact, CORRECTED);
    let mut unknown = pipeline(&map, Effort::Exact, CORRECTED);
    silent.step([observation(1, PersonId(0)), observation(2, PersonId(0))]).unwrap();
    assert!(
        silent.intake().end_window(PersonId(0))
            && !silent.intake().end_window(PersonId(0))
            && !silent.intake().end_window(PersonId(1))
    );
    silent.score().unwrap();
    unknown.score().unwrap();
    assert_eq!(silent.inside().person(PersonId(0)).unwrap().window, 0);
    assert_eq!(silent.scores().grounded.partition_probability, unknown.scores().grounded.partition_probability);
    assert_eq!(silent.scores().stats.calls, 1, "one person was scored");
    silent.score().unwrap();
    assert_eq!(silent.scores().stats.calls, 0, "and once");
}

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
    /// A narrator, with any invented persons, does not change the scores of persons it does not report. It cannot lower the probability that at least
    /// one person enters a room below the value that the other persons give.
    #[test]
    fn a_narrator_moves_no_room_below_what_the_others_give_it(
        honest in prop::collection::vec(0u32..3, 1..12),
        other in prop::collection::vec((2u32..8, 0usize..12), 0..12),
        first in any::<bool>(),
    ) {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let honest: Vec<_> = (1..).zip(&honest).map(|(number, person)| observation(number, PersonId(*person))).collect();
        let said_by_other = |(number, &(person, what)): (u64, &(u32, usize))| {
            let person = PersonId(person);
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
        let spoken_of = |person: PersonId| other.iter().any(|(of, _)| PersonId(*of) == person);
        let mut free = [1.0; 2];
        for own in without.persons().filter(|own| !spoken_of(own.person)) {
            prop_assert_eq!(values(own), values(with.inside().person(own.person).unwrap()));
            free.iter_mut().zip(&own.grounded.partition_probability).for_each(|(free, p)| *free *= 1.0 - p);
        }
        for (free, p) in free.iter().zip(&with.scores().grounded.partition_probability) {
            prop_assert!((1.0 - free) - 1e-12 <= *p && *p <= 1.0, "{p}, and the others alone give {}", 1.0 - free);
        }
    }

    /// However few persons a step scores, the events counted as included are in every person's scores. After the last step the scores equal those of
    /// an unbounded step.
    #[test]
    fn what_is_included_is_scored(
        said in prop::collection::vec((0u32..5, 0u64..3, 0usize..9, 0u64..4, any::<bool>()), 1..80),
    ) {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let mut bounded = pipeline_of(TableModel::slow(7), &map, Effort::Exact, CORRECTED);
        let mut free = pipeline(&map, Effort::Exact, CORRECTED);
        bounded.score().unwrap();
        // Per event: source, sequence, person, and whether the person was scored with it.
        let mut told: Vec<(u64, u64, PersonId, bool)> = Vec::new();
        for (number, &(person, source, what, steps, restarts)) in (1..).zip(&said) {
            let spoken = match what {
                0 => presence(number, PersonId(person), "away"),
                1 => presence(number, PersonId(person), "present"),
                _ => observation(number, PersonId(person)),
            };
            let next = Observation { source, ..spoken };
            free.intake().observe([next.clone()]);
            bounded.intake().observe([next]);
            // Absent persons do not wait, nor do persons with unchanged scores.
            told.push((source, number, PersonId(person), !bounded.inside().waits(PersonId(person))));
            if restarts {
                bounded.intake().forget_quotas();
                free.intake().forget_quotas();
            }
            for _ in 0..steps {
                let before = bounded.scores().included.clone();
                bounded.score_within(1).unwrap();
                prop_assert!(bounded.scores().asked <= 1);
                told.iter_mut().for_each(|own| own.3 |= !bounded.inside().waits(own.2));
                for claim in &bounded.scores().included {
                    let all = told.iter().filter(|own| own.0 == claim.source && own.1 <= claim.sequence);
                    prop_assert!(all.clone().all(|own| own.3), "{claim:?}");
                    prop_assert_eq!(all.count() as u64, claim.accepted);
                    let earlier = before.iter().find(|earlier| earlier.source == claim.source);
                    prop_assert!(earlier.is_none_or(|earlier| earlier.sequence <= claim.sequence));
                }
            }
        }
        while bounded.inside().is_behind() {
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
            prop_assert_eq!(values(own), values(bounded.inside().person(own.person).unwrap()));
        }
    }

    /// A person's scores equal, to the bit, those of a pipeline with that person alone. One person's scores equal the combined scores.
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
        let mut alone = BTreeMap::<PersonId, Pipeline<TableModel>>::new();
        let (mut sequence, mut at_s) = (0, 1);
        for (number, (pause_s, persons)) in steps.iter().enumerate() {
            at_s += pause_s;
            let said: Vec<_> = persons.iter().map(|&(person, what)| {
                sequence += 1;
                let said = match what {
                    0 => presence(sequence, PersonId(person), "away"),
                    1 => presence(sequence, PersonId(person), "present"),
                    2 => presence(sequence, PersonId(person), "present in the kitchen"),
                    3 => presence(sequence, PersonId(person), "gone"),
                    _ => observation(sequence, PersonId(person)),
                };
                Observation { observed_ns: BootNs(at_s * 1_000_000_000), ..said }
            }).collect();
            if *pause_s % 5 == 0 {
                together.intake().end_window(PersonId(2));
                if let Some(own) = alone.get_mut(&PersonId(2)) {
                    own.intake().end_window(PersonId(2));
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
            let own_scores = values(own.inside().person(*person).unwrap());
            prop_assert_eq!(values(together.inside().person(*person).unwrap()), own_scores.clone());
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
                trust: own.scores().trust,
                reached: *reached,
                lower_log_score_nats,
                upper_log_score_nats,
            };
            prop_assert_eq!(values(all), own_scores);
        }
    }
}
