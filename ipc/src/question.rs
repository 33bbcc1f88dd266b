//! Questions and answers as JSON text, for rare requests without a bounded size.
//!
//! | service | question | answer |
//! | --- | --- | --- |
//! | `roomcast/v1/map-change` | changes to the map in use | the result, or the reason for a refusal |
//! | `roomcast/v1/moment` | `{}` | the map in use, the narration in the windows, every label's tokens with their log-probabilities |
//! | `roomcast/v1/person` | list the known persons, forget or name a person | the known persons afterwards, and the result |
//! | `roomcast/v1/habits` | show, forget or replace the learned habits | their size afterwards, and the result |
//!
//! All are request-response services of `[u8]`, UTF-8, with the daemon as the one server. A client may repeat a question without an answer.
//! So each question for a change has an id, and the daemon makes the change of one id once.
//!
//! Shared memory for every possible answer, each of the greatest length, is allocated in advance: later the memory may be full, and the
//! system kills a process that touches a missing page. So an answer of more than [`ANSWER_BYTES_MAX`] bytes goes to a file in the domain's
//! root path, and the service carries `{"answer":"in-file","name":"NAME"}`. The file's name is `DOMAIN_SERVICE-NAME.answer`, with the
//! domain's prefix and the last part of the service's name. NAME is sixteen hexadecimal digits, random for each answer, so clients do not
//! read each other's answers. The client that has read the file removes it, since it may contain personal data. The newest
//! [`ANSWER_FILES_MAX`] unread files stay. If the file cannot be written, the service carries `{"answer":"none","reason":"..."}`.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use iceoryx2::port::client::Client;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{AllocationStrategy, CallbackProgression, PortFactory};
use iceoryx2::service::port_factory::client::ClientCreateError;
use iceoryx2::service::port_factory::request_response;
use iceoryx2::service::port_factory::server::ServerCreateError;

use crate::domain::{Flavour, Node, OpenFailure, Place};
use crate::port::{described, occupied, passing, port, request_response, request_response_failure, wake, waker};
use crate::{IpcError, MessageError, sequence};

/// Changes to the map in use.
pub const MAP_CHANGE: &str = "roomcast/v1/map-change";
/// The data behind the newest scores.
pub const MOMENT: &str = "roomcast/v1/moment";

/// The known persons, and changes to them.
pub const PERSON: &str = "roomcast/v1/person";

/// The learned habits, and changes to them.
pub const HABITS: &str = "roomcast/v1/habits";

/// Most bytes of a question. The daemon alone decides the length of an answer.
pub const QUESTION_BYTES_MAX: usize = 1 << 20;

/// Most bytes of an answer in shared memory.
pub const ANSWER_BYTES_MAX: usize = 1 << 12;

/// Most files of long answers of a service: each of its clients waits for one answer at a time. A client that comes too late for its file
/// asks again.
pub const ANSWER_FILES_MAX: usize = CLIENTS;

/// The name of the file follows.
const IN_FILE: &str = r#"{"answer":"in-file","name":""#;
/// The reason follows, as JSON text without escapes.
const NO_ANSWER: &str = r#"{"answer":"none","reason":""#;
const END: &str = r#""}"#;
const FILE_END: &str = ".answer";

const CLIENTS: usize = 8;
/// The client repeats the question after this time: a daemon that started in between has not received it.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// A daemon that has a question and is silent for so long may be dead.
const LATE: Duration = Duration::from_secs(5);
const POLL: Duration = Duration::from_millis(2);

type Factory = request_response::PortFactory<Flavour, [u8], (), [u8], ()>;

/// Answers questions as JSON text. There is one per service and domain.
#[derive(Debug)]
pub struct AnswerPort {
    server: Server<Flavour, [u8], (), [u8], ()>,
    service: &'static str,
    files: AnswerFiles,
    /// The files of answers, the newest last. Clients have read and removed most of them.
    given: Mutex<VecDeque<PathBuf>>,
}

impl Drop for AnswerPort {
    fn drop(&mut self) {
        self.forget_answers();
    }
}

impl AnswerPort {
    pub(crate) fn open(node: &Node, service: &'static str) -> Result<Self, OpenFailure> {
        let factory = open(node, service)?;
        let server = factory
            .server_builder()
            .initial_max_slice_len(ANSWER_BYTES_MAX)
            // This allocates shared memory for all answers at once, each of the greatest length.
            .max_loaned_responses_per_request(1)
            .create();
        let server = server.map_err(|error| {
            if error != ServerCreateError::ExceedsMaxSupportedServers {
                return passing(service, &error);
            }
            let mut servers = Vec::new();
            factory.dynamic_config().list_servers(|server| {
                servers.push(Place { participant: server.node_id, port: server.server_id.value() });
                CallbackProgression::Continue
            });
            occupied(node, &factory, &servers, service, "server", 1)
        })?;
        let own = Self { server, service, files: AnswerFiles::new(node, service), given: Mutex::default() };
        // A killed daemon may have left files.
        own.forget_answers();
        Ok(own)
    }

    /// Removes all unread files of long answers. Their clients ask again.
    pub fn forget_answers(&self) {
        self.given().clear();
        self.files.remove_all();
    }

    fn given(&self) -> MutexGuard<'_, VecDeque<PathBuf>> {
        self.given.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes a long answer to a file. Returns the text that the service carries instead.
    fn put_into_file(&self, answer: &str) -> String {
        let name = format!("{:016x}", sequence::random_epoch());
        let file = self.files.of(&name);
        // The name is published only after the file is complete.
        if let Err(error) = write_new(&file, answer) {
            let _gone = fs::remove_file(&file);
            return not_given(&format!(
                "the answer of {} bytes cannot be written to {}: {error}; is the disk full?",
                answer.len(),
                file.display()
            ));
        }
        let mut given = self.given();
        given.push_back(file);
        while given.len() > ANSWER_FILES_MAX {
            let _gone = given.pop_front().map(fs::remove_file);
        }
        format!("{IN_FILE}{name}{END}")
    }

    /// Answers all waiting questions, each copied out of shared memory and checked. Returns their number. `respond` also answers a question
    /// that is too long or not UTF-8.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn answer(&self, mut respond: impl FnMut(Result<&str, MessageError>) -> String) -> Result<usize, IpcError> {
        let service = self.service;
        let mut answered = 0;
        while let Some(request) = self.server.receive().map_err(|error| port(service, "receive", &error))? {
            let copy = copied("question", request.payload());
            let question = copy.as_ref().map_err(Clone::clone).and_then(|copy| {
                std::str::from_utf8(copy)
                    .map_err(|error| MessageError::NotUtf8 { field: "question", at: error.valid_up_to() })
            });
            let mut answer = respond(question);
            if answer.len() > ANSWER_BYTES_MAX {
                answer = self.put_into_file(&answer);
            }
            let response = request.loan_slice_uninit(answer.len());
            let sent = response.map(|response| response.write_from_slice(answer.as_bytes()).send());
            // If the client has gone, the daemon goes on.
            answered += usize::from(matches!(sent, Ok(Ok(_))));
        }
        Ok(answered)
    }
}

type Asker = Client<Flavour, [u8], (), [u8], ()>;

/// Asks questions as JSON text.
#[derive(Debug)]
pub struct QuestionPort {
    client: RefCell<Asker>,
    factory: Factory,
    /// The last question got no answer. Its connection may have failed, and iceoryx2 does not try that again.
    unanswered: Cell<bool>,
    service: &'static str,
    files: AnswerFiles,
    waker: Option<Notifier<Flavour>>,
}

impl QuestionPort {
    pub(crate) fn open(node: &Node, service: &'static str) -> Result<Self, OpenFailure> {
        let factory = open(node, service)?;
        let client = RefCell::new(client_of(&factory).map_err(|error| passing(service, &error))?);
        let (unanswered, files, waker) = (Cell::new(false), AnswerFiles::new(node, service), waker(node, service));
        Ok(Self { client, factory, unanswered, service, files, waker })
    }

    /// Asks, and waits for the answer. A question that no daemon has is repeated every half second. A daemon that has it may need longer; an
    /// answer to an earlier question would be lost. A killed daemon seems to have it for some time, so it is repeated after five seconds, too,
    /// and later after as long as all pauses before.
    ///
    /// # Errors
    ///
    /// [`IpcError::NoAnswer`] after `timeout`, [`IpcError::NotGiven`] with the daemon's reason, [`IpcError::Refused`] for a question that
    /// is too long or an answer that is not UTF-8, [`IpcError::Port`].
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
            let late = LATE.max(start.elapsed());
            loop {
                // Looked up before the answer, after which the daemon no longer has the question.
                let pause = if pending.is_connected() { late } else { ASK_AGAIN };
                if let Some(answer) = pending.receive().map_err(|error| port(service, "receive", &error))? {
                    let mut copy = copied("answer", answer.payload()).map_err(refused)?;
                    if let Some(name) = name_of(&copy) {
                        let file = self.files.of(name);
                        copy = match fs::read(&file) {
                            Ok(long) => long,
                            // Newer answers replaced the file, or the daemon removed all of them when it forgot a person. The question is
                            // repeated.
                            Err(error) if error.kind() == io::ErrorKind::NotFound => break,
                            Err(error) => {
                                let operation = "read the answer of";
                                return Err(IpcError::Port { service, operation, cause: Box::new(error) });
                            }
                        };
                        let _gone = fs::remove_file(&file);
                    }
                    let answer = String::from_utf8(copy).map_err(|error| {
                        refused(MessageError::NotUtf8 { field: "answer", at: error.utf8_error().valid_up_to() })
                    })?;
                    let reason = answer.strip_prefix(NO_ANSWER).and_then(|rest| rest.strip_suffix(END));
                    return match reason {
                        Some(reason) => Err(IpcError::NotGiven { service, reason: reason.to_owned() }),
                        None => Ok(answer),
                    };
                }
                if sent.elapsed() >= pause || start.elapsed() >= timeout {
                    break;
                }
                std::thread::sleep(POLL);
            }
        }
        self.unanswered.set(true);
        Err(IpcError::NoAnswer { service, waited_ms: timeout.as_millis() })
    }
}

/// Copies a text out of shared memory, since its sender can still change it: the check must see the text that is used. The sender can also
/// change the length, so its limit is checked first.
fn copied(field: &'static str, text: &[u8]) -> Result<Vec<u8>, MessageError> {
    let (bytes, limit) = (text.len(), QUESTION_BYTES_MAX);
    if bytes > limit { Err(MessageError::TextTooLong { field, bytes, limit }) } else { Ok(text.to_vec()) }
}

fn client_of(factory: &Factory) -> Result<Asker, ClientCreateError> {
    let client = factory.client_builder().initial_max_slice_len(4096);
    client.allocation_strategy(AllocationStrategy::PowerOfTwo).create()
}

fn not_given(reason: &str) -> String {
    let plain = |character| if matches!(character, '"' | '\\') || character < ' ' { '?' } else { character };
    format!("{NO_ANSWER}{}{END}", reason.chars().map(plain).collect::<String>())
}

fn name_of(answer: &[u8]) -> Option<&str> {
    let answer = std::str::from_utf8(answer).ok()?;
    answer.strip_prefix(IN_FILE)?.strip_suffix(END).filter(|name| is_name(name))
}

/// Only such names are read, so that no answer leads to another file.
fn is_name(name: &str) -> bool {
    name.len() == 16 && name.bytes().all(|byte| byte.is_ascii_hexdigit())
}

#[derive(Debug)]
struct AnswerFiles {
    root: PathBuf,
    prefix: String,
}

impl AnswerFiles {
    fn new(node: &Node, service: &str) -> Self {
        let name = service.rsplit('/').next().unwrap_or(service);
        let domain = node.domain();
        Self { root: domain.root().to_owned(), prefix: format!("{}{name}-", domain.prefix()) }
    }

    fn of(&self, name: &str) -> PathBuf {
        self.root.join(format!("{}{name}{FILE_END}", self.prefix))
    }

    /// This includes files of an earlier daemon. A client may remove a file at the same time.
    fn remove_all(&self) {
        for entry in fs::read_dir(&self.root).into_iter().flatten().flatten() {
            let name = entry.file_name();
            let own = name.to_str().and_then(|name| name.strip_prefix(&self.prefix)?.strip_suffix(FILE_END));
            if own.is_some_and(is_name) {
                let _gone = fs::remove_file(entry.path());
            }
        }
    }
}

fn write_new(path: &Path, text: &str) -> io::Result<()> {
    let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    file.write_all(text.as_bytes())
}

fn open(node: &Node, service: &'static str) -> Result<Factory, OpenFailure> {
    let opened = request_response!(node, service, [u8], [u8], CLIENTS);
    opened.map_err(|error| request_response_failure(node, service, &described("[u8]", 1), &error))
}

impl Node {
    /// Opens the server of a service of this module.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn answer_port(&self, service: &'static str) -> Result<AnswerPort, IpcError> {
        self.retry(|| AnswerPort::open(self, service))
    }

    /// Opens a client of a service of this module.
    ///
    /// # Errors
    ///
    /// As [`Node::publisher`].
    pub fn question_port(&self, service: &'static str) -> Result<QuestionPort, IpcError> {
        self.retry(|| QuestionPort::open(self, service))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Domain;

    /// The length is in memory that the client can change. A copy of that length once crashed the daemon.
    #[test]
    #[expect(unsafe_code, reason = "the asker writes to the header of its own question")]
    fn a_question_that_is_said_to_be_endless_is_refused() {
        const BYTES: u64 = 1234;
        let root = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(root.path(), &format!("endless-{}", std::process::id())).unwrap();
        let node = domain.open("both").unwrap();
        let (server, port) = (node.answer_port(MOMENT).unwrap(), node.question_port(MOMENT).unwrap());
        let client = port.client.borrow();
        let question = client.loan_slice_uninit(BYTES as usize).unwrap().write_from_slice(&[b' '; BYTES as usize]);
        let words = size_of_val(question.header()) / size_of::<u64>();
        let header = std::ptr::from_ref(question.header()).cast_mut().cast::<u64>();
        // SAFETY: the header has this many words, and is in the client's own shared memory, which may be written to.
        let numbers: Vec<_> = (0..words).map(|word| unsafe { header.add(word) }).collect();
        // SAFETY: as above.
        let number = numbers.into_iter().find(|number| unsafe { number.read_volatile() } == BYTES).unwrap();
        // SAFETY: as above.
        unsafe { number.write_volatile(1 << 40) };
        let pending = question.send().unwrap();
        let answer = |asked: Result<&str, MessageError>| asked.unwrap_err().to_string();
        assert_eq!(server.answer(answer).unwrap(), 1);
        let answer = String::from_utf8(pending.receive().unwrap().unwrap().payload().to_vec()).unwrap();
        assert!(answer.contains("1099511627776"), "{answer}");
        drop((pending, client));
        drop((port, server, node));
        domain.clean_up().unwrap();
    }

    #[test]
    fn an_answer_leads_to_no_file_but_one_of_an_answer() {
        let named = |name: &str| name_of(format!("{IN_FILE}{name}{END}").as_bytes()).map(str::to_owned);
        assert_eq!(named("0123456789abcdef").as_deref(), Some("0123456789abcdef"));
        for name in ["", "0123456789abcde", "0123456789abcdef0", "0123456789abcde/", "../../etc/passwd"] {
            assert_eq!(named(name), None, "{name:?}");
        }
    }
}
