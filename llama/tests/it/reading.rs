//! What the model reads before an event: the same scores, and no event that reads a whole window.

use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::narration::{Action, Observation, Program, Sentence};
use roomcast_core::pipeline::Pipeline;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_llama::{LlamaModel, LlamaOptions};

fn pipeline(options: &LlamaOptions) -> Pipeline<LlamaModel> {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/household.gguf");
    let map = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/apartment-e0.json");
    let map = SemanticMap::load(map).unwrap();
    Pipeline::of(&map, LlamaModel::load(file.as_ref(), options).unwrap()).unwrap()
}

fn sentences() -> Vec<String> {
    let program = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/programs/p2-long-evening.txt");
    let program = Program::parse(&std::fs::read_to_string(program).unwrap()).unwrap();
    program.steps.iter().map(Action::sentence).cycle().take(60).collect()
}

fn observation(sequence: u64, person: u32, sentence: &str) -> Observation {
    let observed_ns = BootNs(sequence * 1_000_000_000);
    let sentence = Sentence::new(sentence).unwrap();
    Observation { person: PersonId(person), observed_ns, ..Observation::of(sequence, sentence) }
}

fn bits(pipeline: &Pipeline<LlamaModel>) -> Vec<u64> {
    pipeline.persons().flat_map(|person| person.label_log_prob_nats).map(|nats| nats.to_bits()).collect()
}

/// The tokens of each event's prompt that were decoded with it.
fn decoded(
    persons: u32,
    options: &LlamaOptions,
    idle: impl Fn(&mut Pipeline<LlamaModel>),
) -> (Vec<u32>, Vec<Vec<u64>>) {
    let mut pipeline = pipeline(options);
    let (mut decoded, mut scores) = (Vec::new(), Vec::new());
    for (sequence, sentence) in (1..).zip(sentences()) {
        let person = u32::try_from(sequence).unwrap() % persons;
        decoded.push(pipeline.step([observation(sequence, person, &sentence)]).unwrap().stats.prompt_tokens_decoded);
        scores.push(bits(&pipeline));
        idle(&mut pipeline);
    }
    (decoded, scores)
}

#[test]
fn windows_that_are_read_before_their_cut_score_the_same_to_the_last_bit() {
    let options = LlamaOptions { threads: 1, ..LlamaOptions::default() };
    let (whole, scores) = decoded(1, &options, |_| ());
    let (parts, after_events) = decoded(1, &options, |pipeline| pipeline.idle().read_on());
    let (idle, after_idle) = decoded(1, &options, |pipeline| while pipeline.idle().tidy() {});
    let most = |decoded: &[u32]| decoded[1..].iter().max().copied().unwrap();
    println!("whole {whole:?}\nin parts {parts:?}\nidle {idle:?}");
    assert!(most(&whole) > 30, "an event reads a whole window: {whole:?}");
    assert!(most(&parts) < 10 && most(&idle) < 10, "{parts:?} {idle:?}");
    let first = (scores.iter().zip(&after_events).zip(&after_idle)).position(|((a, b), c)| a != b || a != c);
    assert_eq!(first, None, "the first event with other scores");
}

#[test]
fn windows_of_persons_who_act_in_turn_stay_read() {
    let options = LlamaOptions { threads: 1, ..LlamaOptions::default() };
    let (whole, scores) = decoded(2, &options, |_| ());
    let (parts, after_events) = decoded(2, &options, |pipeline| pipeline.idle().read_on());
    println!("whole {whole:?}\nin parts {parts:?}");
    let sum = |decoded: &[u32]| decoded.iter().sum::<u32>();
    assert!(3 * sum(&parts) < sum(&whole), "{whole:?} {parts:?}");
    assert_eq!(scores, after_events);
    // Nothing of a forgotten person stays.
    let mut pipeline = pipeline(&options);
    for (sequence, sentence) in (1..40).zip(sentences()) {
        pipeline.step([observation(sequence, sequence as u32 % 2, &sentence)]).unwrap();
        pipeline.idle().read_on();
    }
    pipeline.intake().forget_person(PersonId(1));
    let again = pipeline.step([observation(50, 0, "They sit on the sofa.")]).unwrap();
    assert_eq!(again.stats.prompt_tokens_decoded as usize, again.prompt_tokens);
}
