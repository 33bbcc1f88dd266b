//! Questions and answers in words: what is asked now and then, and has no bounded size, goes as JSON text.
//!
//! | service | asked | answered |
//! | --- | --- | --- |
//! | `roomcast/v1/map-change` | changes to the map in use | what became of them, or why not |
//! | `roomcast/v1/moment` | nothing (`{}`) | the map in use, the narration in the windows, every label's tokens with their log-probabilities |
//! | `roomcast/v1/person` | who is known; to forget a person, to give them a name | who is known then, and what became of the change |
//! | `roomcast/v1/habits` | what was learned of the home; to forget it, to replace it | how much is known then, and what became of the change |
//!
//! All are request-response services of `[u8]`, UTF-8. The daemon is the one server. A question may be asked again when no answer
//! came, so whoever asks for a change names it, and the daemon does a change of the same name once.
//!
//! Shared memory is set aside for every answer that may be under way, each as long as the longest. So an answer of more than
//! [`ANSWER_BYTES_MAX`] bytes lies in a file of the domain's root path, and what comes by the service is [`ANSWER_IN_FILE`]. Where the file cannot
//! be written, `{"answer":"none","reason":"..."}` comes.

use std::cell::{Cell, RefCell};
use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::port::client::Client;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{AllocationStrategy, CallbackProgression, PortFactory};
use iceoryx2::service::port_factory::client::ClientCreateError;
use iceoryx2::service::port_factory::request_response;

use crate::domain::{Flavour, Node, OpenFailure, Place};
use crate::port::{described, occupied, passing, port, request_response, request_response_failure, wake, waker};
use crate::{IpcError, MessageError};

/// Changes to the map in use.
pub const MAP_CHANGE: &str = "roomcast/v1/map-change";
/// All that is behind the scores of this moment.
pub const MOMENT: &str = "roomcast/v1/moment";

/// Who is known, and changes to that.
pub const PERSON: &str = "roomcast/v1/person";

/// What was learned of the home, and changes to that.
pub const HABITS: &str = "roomcast/v1/habits";

/// Most bytes of a question. An answer's length is the daemon's own affair.
pub const QUESTION_BYTES_MAX: usize = 1 << 20;

/// Most bytes of an answer in shared memory.
pub const ANSWER_BYTES_MAX: usize = 1 << 16;

/// The answer that says: it lies in the file `NAME_SERVICE.answer` of the root path, with the domain's name and the last part of the
/// service's. Whoever has read it removes it, since it may tell of persons. The next question removes one that nobody has read.
pub const ANSWER_IN_FILE: &str = r#"{"answer":"in-file"}"#;

/// How the answer begins that says: there is none, for the reason that follows, in a text of JSON without escapes.
const NO_ANSWER: &str = r#"{"answer":"none","reason":""#;
/// How it ends.
const NO_ANSWER_END: &str = r#""}"#;

const CLIENTS: usize = 8;
/// A daemon that starts after a question was sent never gets it: it is asked again after this.
const ASK_AGAIN: Duration = Duration::from_millis(500);
const POLL: Duration = Duration::from_millis(2);

type Factory = request_response::PortFactory<Flavour, [u8], (), [u8], ()>;

/// Answers questions in words. There is one per service and domain.
#[derive(Debug)]
pub struct AnswerPort {
    server: Server<Flavour, [u8], (), [u8], ()>,
    service: &'static str,
    /// For answers that are too long.
    file: PathBuf,
}

impl Drop for AnswerPort {
    fn drop(&mut self) {
        self.forget_answer();
    }
}

impl AnswerPort {
    pub(crate) fn open(node: &Node, service: &'static str) -> Result<Self, OpenFailure> {
        let factory = open(node, service)?;
        let server = factory
            .server_builder()
            .initial_max_slice_len(4096)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            // Shared memory is set aside for as many answers as may be, each as long as the longest.
            .max_loaned_responses_per_request(1)
            .create();
        let server = server.map_err(|_| {
            let mut servers = Vec::new();
            factory.dynamic_config().list_servers(|server| {
                servers.push(Place { participant: server.node_id, port: server.server_id.value() });
                CallbackProgression::Continue
            });
            occupied(node, &factory, &servers, service, "server", 1)
        })?;
        let own = Self { server, service, file: node.answer_file(service) };
        // A daemon that was killed may have left one.
        own.forget_answer();
        Ok(own)
    }

    /// Removes an answer that was too long for shared memory and that nobody has read.
    pub fn forget_answer(&self) {
        // Mostly there is none.
        let _gone = fs::remove_file(&self.file);
        let _gone = fs::remove_file(unfinished(&self.file));
    }

    /// Answers all questions that wait, each copied out of shared memory and checked; returns how many. What is no text, or too
    /// long, gets its answer from `respond` too.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn answer(&self, mut respond: impl FnMut(Result<&str, MessageError>) -> String) -> Result<usize, IpcError> {
        let fail = |error: &dyn std::fmt::Debug| port(self.service, "receive", &error);
        let mut answered = 0;
        while let Some(request) = self.server.receive().map_err(|error| fail(&error))? {
            // Its sender can still write to it: what is checked must be what is used.
            let copy = request.payload().to_vec();
            let question = if copy.len() > QUESTION_BYTES_MAX {
                Err(MessageError::TextTooLong { field: "question", bytes: copy.len(), limit: QUESTION_BYTES_MAX })
            } else {
                std::str::from_utf8(&copy)
                    .map_err(|error| MessageError::NotUtf8 { field: "question", at: error.valid_up_to() })
            };
            let mut answer = respond(question);
            self.forget_answer();
            if answer.len() > ANSWER_BYTES_MAX {
                answer = match write_whole(&self.file, &answer) {
                    Ok(()) => ANSWER_IN_FILE.to_owned(),
                    Err(error) => {
                        self.forget_answer();
                        not_given(&format!(
                            "the answer of {} bytes cannot be written to {}: {error}; is the disk full?",
                            answer.len(),
                            self.file.display()
                        ))
                    }
                };
            }
            let response = request.loan_slice_uninit(answer.len());
            let sent = response.map(|response| response.write_from_slice(answer.as_bytes()).send());
            // An asker that has gone away meanwhile is no failure of the daemon.
            answered += usize::from(matches!(sent, Ok(Ok(_))));
        }
        Ok(answered)
    }
}

type Asker = Client<Flavour, [u8], (), [u8], ()>;

/// Asks questions in words.
#[derive(Debug)]
pub struct QuestionPort {
    client: RefCell<Asker>,
    factory: Factory,
    /// Nobody answered the last question: perhaps its connection could not be made, which iceoryx2 does not try again.
    unanswered: Cell<bool>,
    service: &'static str,
    file: PathBuf,
    waker: Option<Notifier<Flavour>>,
}

impl QuestionPort {
    pub(crate) fn open(node: &Node, service: &'static str) -> Result<Self, OpenFailure> {
        let factory = open(node, service)?;
        let client = RefCell::new(client_of(&factory).map_err(|error| passing(service, &error))?);
        let (unanswered, file, waker) = (Cell::new(false), node.answer_file(service), waker(node, service));
        Ok(Self { client, factory, unanswered, service, file, waker })
    }

    /// Asks, and waits for the answer; asks again now and then while none comes.
    ///
    /// # Errors
    ///
    /// [`IpcError::NoAnswer`] after `timeout`, [`IpcError::NotGiven`] where the daemon says why it has none, [`IpcError::Refused`] for a question that is too long or an answer that is no
    /// text, [`IpcError::Port`].
    pub fn ask(&self, question: &str, timeout: Duration) -> Result<String, IpcError> {
        let service = self.service;
        let refused = |source| IpcError::Refused { service, source };
        if question.len() > QUESTION_BYTES_MAX {
            let (bytes, limit) = (question.len(), QUESTION_BYTES_MAX);
            return Err(refused(MessageError::TextTooLong { field: "question", bytes, limit }));
        }
        if self.unanswered.replace(false)
            && let Ok(client) = client_of(&self.factory)
        {
            self.client.replace(client);
        }
        let start = Instant::now();
        while start.elapsed() < timeout {
            let client = self.client.borrow();
            let request = client.loan_slice_uninit(question.len());
            let request = request.map_err(|error| port(service, "send", &error))?;
            let pending = request.write_from_slice(question.as_bytes()).send();
            let pending = pending.map_err(|error| port(service, "send", &error))?;
            wake(self.waker.as_ref());
            let sent = Instant::now();
            while sent.elapsed() < ASK_AGAIN && start.elapsed() < timeout {
                if let Some(answer) = pending.receive().map_err(|error| port(service, "receive", &error))? {
                    let mut copy = answer.payload().to_vec();
                    if copy == ANSWER_IN_FILE.as_bytes() {
                        copy = match fs::read(&self.file) {
                            Ok(long) => long,
                            // Somebody else has asked and read since: this is asked again.
                            Err(error) if error.kind() == io::ErrorKind::NotFound => break,
                            Err(error) => return Err(port(service, "read the answer of", &error)),
                        };
                        let _gone = fs::remove_file(&self.file);
                    }
                    let answer = String::from_utf8(copy).map_err(|error| {
                        refused(MessageError::NotUtf8 { field: "answer", at: error.utf8_error().valid_up_to() })
                    })?;
                    let reason = answer.strip_prefix(NO_ANSWER).and_then(|rest| rest.strip_suffix(NO_ANSWER_END));
                    return match reason {
                        Some(reason) => Err(IpcError::NotGiven { service, reason: reason.to_owned() }),
                        None => Ok(answer),
                    };
                }
                std::thread::sleep(POLL);
            }
        }
        self.unanswered.set(true);
        Err(IpcError::NoAnswer { service, waited_ms: timeout.as_millis() })
    }
}

fn client_of(factory: &Factory) -> Result<Asker, ClientCreateError> {
    let client = factory.client_builder().initial_max_slice_len(4096);
    client.allocation_strategy(AllocationStrategy::PowerOfTwo).create()
}

/// The answer that says why there is none.
fn not_given(reason: &str) -> String {
    let plain = |character| if matches!(character, '"' | '\\') || character < ' ' { '?' } else { character };
    format!("{NO_ANSWER}{}{NO_ANSWER_END}", reason.chars().map(plain).collect::<String>())
}

fn unfinished(path: &Path) -> PathBuf {
    path.with_extension("unfinished")
}

/// Replaces a file at once, so that nobody reads half of it.
fn write_whole(path: &Path, text: &str) -> io::Result<()> {
    let unfinished = unfinished(path);
    let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(&unfinished)?;
    file.write_all(text.as_bytes())?;
    fs::rename(&unfinished, path)
}

fn open(node: &Node, service: &'static str) -> Result<Factory, OpenFailure> {
    let opened = request_response!(node, service, [u8], [u8], CLIENTS);
    opened.map_err(|error| request_response_failure(node, service, &described("[u8]", 1), &error))
}

/// Opens them.
impl Node {
    /// The place that answers questions of a service of this module.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn answer_port(&self, service: &'static str) -> Result<AnswerPort, IpcError> {
        self.retry(|| AnswerPort::open(self, service))
    }

    /// Asks questions of a service of this module.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn question_port(&self, service: &'static str) -> Result<QuestionPort, IpcError> {
        self.retry(|| QuestionPort::open(self, service))
    }
}
