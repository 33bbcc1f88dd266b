//! Prompts cut into tokens sentence by sentence are those cut whole, with the model that ships.

use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use roomcast_core::scorer::cutter::{Cutter, REMEMBERED};
use roomcast_core::scorer::{LanguageModel, TextStart};
use roomcast_llama::{LlamaModel, LlamaOptions};

/// Sentences, and what narrators should not send: more of them than are remembered, and joined in every way.
#[test]
fn a_prompt_cut_by_sentences_is_the_prompt_cut_whole() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/household.gguf");
    let model = LlamaModel::load(file.as_ref(), &LlamaOptions { context_tokens: 64, ..Default::default() }).unwrap();
    assert!(model.sentences_apart(), "no token of the embedded model crosses from one sentence to the next");
    let texts: Vec<(String, Vec<i32>)> =
        serde_json::from_str(include_str!("../../../models/household-tokens.json")).unwrap();
    let texts: Vec<String> = texts.into_iter().map(|(text, _)| text).collect();
    assert!(texts.len() > REMEMBERED);
    let joint = prop::sample::select(vec![". ", ".  ", " ", ".", "", ". . ", "...", ".\u{2581}", "? ", "! ", "?! "]);
    let prompt = prop::collection::vec((prop::sample::select(texts), joint), 0..12);
    let cutter = std::cell::RefCell::new(Cutter::default());
    let mut runner = TestRunner::new(Config { cases: 2000, failure_persistence: None, ..Config::default() });
    let result = runner.run(&prompt, |parts| {
        let mut prompt: String = parts.iter().flat_map(|(text, joint)| [text.as_str(), joint]).collect();
        let (mut whole, mut cut) = (Vec::new(), Vec::new());
        model.tokenise(&prompt, TextStart::Sequence, &mut whole).unwrap();
        cutter.borrow_mut().cut_prompt(&model, &prompt, &mut cut).unwrap();
        prop_assert_eq!(&cut, &whole, "{:?}", prompt);
        // As the next event has it: the same narration, and a little more.
        for more in [" They walk to the sink.", ".", " "] {
            prompt.push_str(more);
            whole.clear();
            model.tokenise(&prompt, TextStart::Sequence, &mut whole).unwrap();
            cutter.borrow_mut().cut_prompt(&model, &prompt, &mut cut).unwrap();
            prop_assert_eq!(&cut, &whole, "{:?}", prompt);
        }
        whole.clear();
        model.tokenise(&prompt, TextStart::Within, &mut whole).unwrap();
        cutter.borrow_mut().cut_narration(&model, &prompt, TextStart::Within, &mut cut).unwrap();
        prop_assert_eq!(&cut, &whole, "{:?}", prompt);
        Ok(())
    });
    result.unwrap();
}

/// A long text is cut by llama.cpp, and a short one is not. So a short text before a long one has the same tokens both ways.
#[test]
fn short_texts_have_the_tokens_of_llama_cpp() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/household.gguf");
    let model = LlamaModel::load(file.as_ref(), &LlamaOptions { context_tokens: 64, ..Default::default() }).unwrap();
    let after = format!(" {}.", "They walk to the sink. ".repeat(12));
    let text = "[ -~]{0,40}|[a-z]{1,9}( [a-zA-Z']{1,9}){0,12}|(They|the|fridge|walk|to|[a-z]{1,3}| |, ){0,20}";
    let cut = |text: &str| {
        let mut tokens = Vec::new();
        model.tokenise(text, TextStart::Within, &mut tokens).unwrap();
        tokens
    };
    let mut runner = TestRunner::new(Config { cases: 3000, failure_persistence: None, ..Config::default() });
    let result = runner.run(&text, |text| {
        let text = text + ".";
        prop_assert_eq!(cut(&format!("{text}{after}")), [cut(&text), cut(&after[1..])].concat(), "{:?}", text);
        Ok(())
    });
    result.unwrap();
}
