//! Reads a Home Assistant's registries over its WebSocket API, as the texts of its configuration folder.
//!
//! All reads must end within [`TIME_MAX`], and no message may exceed [`MESSAGE_BYTES_MAX`], so that another or a hostile host costs bounded time and
//! memory. The token goes only to the named host, and its file must be private.

use std::io::{self, Read, Write};
use std::net::{IpAddr, TcpStream, ToSocketAddrs};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};
use serde_json::{Value, json};
use tungstenite::client::client_with_config;
use tungstenite::handshake::HandshakeError;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error as SocketError, Message, WebSocket};

use roomcast_core::semantic_map::import::Registries;

/// Longest time for all questions and answers together.
const TIME_MAX: Duration = Duration::from_secs(60);
/// Longest time to connect to one address of the host.
const CONNECT_MAX: Duration = Duration::from_secs(5);
const MESSAGE_BYTES_MAX: usize = 64 << 20;
/// Most bytes of a token; Home Assistant's have under 200.
const TOKEN_BYTES_MAX: u64 = 4096;
/// Most messages that are skipped between a question and its answer.
const STRAY_MAX: usize = 100;
/// Entities per question.
const ENTITIES_AT_ONCE: usize = 500;

#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RegistriesError {
    #[error(
        "{given:?} is no Home Assistant's address: give what a browser opens it with, such as http://homeassistant.local:8123"
    )]
    Address { given: String },
    #[error("the token file {path}: {fault}")]
    Token { path: PathBuf, fault: String },
    #[error("the certificates {path}: {fault}; give a PEM file with those that Home Assistant's is signed by")]
    Authority { path: PathBuf, fault: String },
    #[error(
        "no host {host:?} is known ({fault}): check the name, or give its number, such as http://192.168.1.20:8123"
    )]
    Host { host: String, fault: String },
    #[error("{url} cannot be reached ({fault}): check that Home Assistant runs and the port (8123 by default)")]
    Unreachable { url: String, fault: String },
    #[error("{url} is no Home Assistant: {fault}; give what a browser opens Home Assistant with")]
    Foreign { url: String, fault: String },
    #[error(
        "Home Assistant at {url} refuses the token ({fault}): make a long-lived access token on your profile's page there (Security), and \
         write it alone into {path}"
    )]
    Refused { url: String, fault: String, path: PathBuf },
    #[error(
        "Home Assistant {version} refuses `{question}` ({fault}): make the token as an administrator, or update Home Assistant"
    )]
    Question { version: String, question: &'static str, fault: String },
    #[error(
        "the connection to {url} failed ({fault}): try again; a configuration folder can be imported without a connection"
    )]
    Lost { url: String, fault: String },
}

/// The registries, each in the format of its file in `.storage`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fetched {
    pub version: String,
    areas: String,
    floors: Option<String>,
    devices: String,
    entities: String,
    persons: Option<String>,
}

impl Fetched {
    #[must_use]
    pub fn registries(&self) -> Registries<'_> {
        Registries {
            areas: &self.areas,
            floors: self.floors.as_deref(),
            devices: Some(&self.devices),
            entities: Some(&self.entities),
            persons: self.persons.as_deref(),
            ..Registries::default()
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Address {
    secure: bool,
    host: String,
    port: u16,
    path: String,
}

impl Address {
    /// Accepts `http://HOST[:PORT][/PATH]`, also with `https`, `ws` and `wss`, with or without the API's own path.
    fn parse(given: &str) -> Result<Self, RegistriesError> {
        let wrong = || RegistriesError::Address { given: given.to_owned() };
        let (scheme, rest) = given.split_once("://").ok_or_else(wrong)?;
        let secure = match scheme {
            "http" | "ws" => false,
            "https" | "wss" => true,
            _ => return Err(wrong()),
        };
        let (place, path) = rest.split_once('/').unwrap_or((rest, ""));
        // A bare number with colons is an IPv6 address; before a port it needs brackets.
        let (host, port) = match place.strip_prefix('[').and_then(|place| place.split_once(']')) {
            Some((host, "")) => (host, None),
            Some((host, port)) => (host, Some(port.strip_prefix(':').ok_or_else(wrong)?)),
            None => place.split_once(':').map_or((place, None), |(host, port)| (host, Some(port))),
        };
        let port = match port {
            Some(port) => port.parse().map_err(|_| wrong())?,
            None if secure => 443,
            None => 8123,
        };
        let sound = |text: &str| text.chars().all(|c| c.is_ascii_graphic() && !"\"<>\\^`{|}@?#".contains(c));
        if host.is_empty() || !sound(host) || !sound(path) || host.contains('/') {
            return Err(wrong());
        }
        let base = path.trim_end_matches('/').trim_end_matches("api/websocket").trim_end_matches('/');
        let path = if base.is_empty() { "/api/websocket".to_owned() } else { format!("/{base}/api/websocket") };
        Ok(Self { secure, host: host.to_owned(), port, path })
    }

    fn url(&self) -> String {
        let Self { secure, host, port, path } = self;
        let bracketed = if host.contains(':') { format!("[{host}]") } else { host.clone() };
        format!("{}://{bracketed}:{port}{path}", if *secure { "wss" } else { "ws" })
    }

    fn shown(&self) -> String {
        self.url().replacen("ws", "http", 1).trim_end_matches("/api/websocket").to_owned()
    }

    fn connect(&self) -> Result<TcpStream, RegistriesError> {
        let unknown = |fault: String| RegistriesError::Host { host: self.host.clone(), fault };
        let found = (self.host.as_str(), self.port).to_socket_addrs().map_err(|error| unknown(error.to_string()))?;
        let mut failed = None;
        for address in found {
            match TcpStream::connect_timeout(&address, CONNECT_MAX) {
                Ok(stream) => return Ok(stream),
                Err(error) => failed = Some(error),
            }
        }
        let Some(error) = failed else { return Err(unknown("it has no address".to_owned())) };
        Err(RegistriesError::Unreachable { url: self.shown(), fault: error.to_string() })
    }
}

/// A connection with one deadline for all reads and writes.
struct Timed {
    stream: TcpStream,
    until: Instant,
}

impl Timed {
    fn left(&self) -> io::Result<Option<Duration>> {
        let left = self.until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(timed_out(io::ErrorKind::TimedOut.into()));
        }
        Ok(Some(left))
    }
}

/// A socket reports its timeout as "would block", which callers would retry.
fn timed_out(error: io::Error) -> io::Error {
    match error.kind() {
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => {
            io::Error::new(io::ErrorKind::TimedOut, format!("it took longer than {} s", TIME_MAX.as_secs()))
        }
        _ => error,
    }
}

impl Read for Timed {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.stream.set_read_timeout(self.left()?)?;
        self.stream.read(buffer).map_err(timed_out)
    }
}

impl Write for Timed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(self.left()?)?;
        self.stream.write(bytes).map_err(timed_out)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

trait Stream: Read + Write {}
impl<T: Read + Write> Stream for T {}

/// An authenticated connection.
struct Connection {
    url: String,
    version: String,
    socket: WebSocket<Box<dyn Stream>>,
    asked: u64,
}

enum Answer {
    Result(Value),
    /// Home Assistant is older than the question.
    Unknown,
}

/// The token in a file that only its owner can read.
///
/// # Errors
///
/// [`RegistriesError::Token`] if the file cannot be read, others can read it, or it holds no token.
pub fn read_token(path: &Path) -> Result<String, RegistriesError> {
    let wrong = |fault: String| RegistriesError::Token { path: path.to_owned(), fault };
    let failed = |error: io::Error| wrong(format!("{error}; write the token alone into this file"));
    let file = std::fs::File::open(path).map_err(failed)?;
    let about = file.metadata().map_err(failed)?;
    if !about.is_file() {
        return Err(wrong("it is no plain file: write the token alone into one, and give that".to_owned()));
    }
    if about.permissions().mode() & 0o077 != 0 {
        return Err(wrong(format!("others may read it; take the right from them: chmod 600 {}", path.display())));
    }
    let mut text = String::new();
    file.take(TOKEN_BYTES_MAX + 1).read_to_string(&mut text).map_err(failed)?;
    let token = text.trim();
    if token.is_empty() || token.len() as u64 > TOKEN_BYTES_MAX || !token.chars().all(|c| c.is_ascii_graphic()) {
        return Err(wrong("it holds no token: write one into it alone, on one line".to_owned()));
    }
    Ok(token.to_owned())
}

fn tls(authority: Option<&Path>) -> Result<Arc<ClientConfig>, RegistriesError> {
    let mut roots = RootCertStore::empty();
    match authority {
        Some(path) => {
            let wrong = |fault: String| RegistriesError::Authority { path: path.to_owned(), fault };
            let pem = std::fs::read(path).map_err(|error| wrong(error.to_string()))?;
            for certificate in CertificateDer::pem_slice_iter(&pem) {
                let certificate = certificate.map_err(|error| wrong(error.to_string()))?;
                roots.add(certificate).map_err(|error| wrong(error.to_string()))?;
            }
            if roots.is_empty() {
                return Err(wrong("it holds no certificate".to_owned()));
            }
        }
        None => roots.extend(webpki_roots::TLS_SERVER_ROOTS.iter().cloned()),
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions();
    let config = config.map_err(|error| RegistriesError::Authority {
        path: authority.unwrap_or(Path::new("built in")).to_owned(),
        fault: error.to_string(),
    })?;
    Ok(Arc::new(config.with_root_certificates(roots).with_no_client_auth()))
}

impl Connection {
    fn open(
        address: &Address,
        token: &str,
        token_file: &Path,
        tls: Option<Arc<ClientConfig>>,
    ) -> Result<Self, RegistriesError> {
        let url = address.shown();
        let stream = Timed { stream: address.connect()?, until: Instant::now() + TIME_MAX };
        let unreachable = |fault: String| RegistriesError::Unreachable { url: url.clone(), fault };
        let stream: Box<dyn Stream> = match tls {
            None => Box::new(stream),
            Some(config) => {
                let host = address.host.parse::<IpAddr>().map(|ip| ServerName::IpAddress(ip.into()));
                let name = host.or_else(|_| ServerName::try_from(address.host.clone()));
                let name = name.map_err(|_| RegistriesError::Address { given: url.clone() })?;
                let connection = ClientConnection::new(config, name).map_err(|error| unreachable(error.to_string()))?;
                Box::new(StreamOwned::new(connection, stream))
            }
        };
        let limits = WebSocketConfig::default();
        let limits = limits.max_message_size(Some(MESSAGE_BYTES_MAX)).max_frame_size(Some(MESSAGE_BYTES_MAX));
        let (socket, _) =
            client_with_config(address.url().as_str(), stream, Some(limits)).map_err(|error| match error {
                // No TLS at all. A refused certificate is an error of the same kind, with its own text.
                HandshakeError::Failure(SocketError::Io(error))
                    if address.secure && error.to_string().contains("corrupt message") =>
                {
                    RegistriesError::Foreign { url: url.clone(), fault: "nobody speaks https at this port".to_owned() }
                }
                HandshakeError::Failure(SocketError::Io(error)) => {
                    RegistriesError::Lost { url: url.clone(), fault: error.to_string() }
                }
                HandshakeError::Failure(SocketError::Http(response)) => {
                    let fault = format!("it answers {}", response.status());
                    RegistriesError::Foreign { url: url.clone(), fault }
                }
                HandshakeError::Failure(error) => {
                    RegistriesError::Foreign { url: url.clone(), fault: error.to_string() }
                }
                HandshakeError::Interrupted(_) => {
                    RegistriesError::Lost { url: url.clone(), fault: "it was interrupted".to_owned() }
                }
            })?;
        let mut connection = Self { url, version: "of unknown version".to_owned(), socket, asked: 0 };
        connection.introduce(token, token_file)?;
        Ok(connection)
    }

    fn introduce(&mut self, token: &str, path: &Path) -> Result<(), RegistriesError> {
        let hello = self.hear()?;
        if hello["type"] != "auth_required" {
            return Err(self.foreign("it does not ask for a token"));
        }
        if let Some(version) = hello["ha_version"].as_str() {
            self.version = plain(version);
        }
        self.say(&json!({ "type": "auth", "access_token": token }))?;
        let answer = self.hear()?;
        match answer["type"].as_str() {
            Some("auth_ok") => Ok(()),
            Some("auth_invalid") => Err(RegistriesError::Refused {
                url: self.url.clone(),
                fault: plain(answer["message"].as_str().unwrap_or("it does not say why")),
                path: path.to_owned(),
            }),
            _ => Err(self.foreign("it answers a token with neither yes nor no")),
        }
    }

    fn foreign(&self, fault: &str) -> RegistriesError {
        RegistriesError::Foreign { url: self.url.clone(), fault: fault.to_owned() }
    }

    fn lost(&self, error: SocketError) -> RegistriesError {
        let fault = match error {
            // Without tungstenite's prefix.
            SocketError::Io(error) => error.to_string(),
            SocketError::Capacity(_) => format!("an answer has more than {MESSAGE_BYTES_MAX} bytes"),
            error => error.to_string(),
        };
        RegistriesError::Lost { url: self.url.clone(), fault }
    }

    fn say(&mut self, message: &Value) -> Result<(), RegistriesError> {
        self.socket.send(Message::text(message.to_string())).map_err(|error| self.lost(error))
    }

    fn hear(&mut self) -> Result<Value, RegistriesError> {
        for _ in 0..STRAY_MAX {
            match self.socket.read() {
                Ok(Message::Text(text)) => {
                    return serde_json::from_str(&text)
                        .map_err(|error| self.foreign(&format!("it speaks no JSON ({error})")));
                }
                Ok(Message::Close(_)) => return Err(self.lost(SocketError::ConnectionClosed)),
                Ok(_) => {}
                Err(error) => return Err(self.lost(error)),
            }
        }
        Err(self.foreign("it says nothing that is text"))
    }

    fn ask(&mut self, question: &'static str, more: Value) -> Result<Answer, RegistriesError> {
        self.asked += 1;
        let mut message = more;
        (message["id"], message["type"]) = (self.asked.into(), question.into());
        self.say(&message)?;
        for _ in 0..STRAY_MAX {
            let mut answer = self.hear()?;
            if answer["id"].as_u64() != Some(self.asked) {
                continue;
            }
            if answer["success"] == true {
                return Ok(Answer::Result(answer["result"].take()));
            }
            let error = &answer["error"];
            if error["code"] == "unknown_command" {
                return Ok(Answer::Unknown);
            }
            let word = |key: &str| plain(error[key].as_str().unwrap_or_default());
            let fault = format!("{} {}", word("code"), word("message")).trim().to_owned();
            return Err(RegistriesError::Question { version: self.version.clone(), question, fault });
        }
        Err(self.foreign("it does not answer a question"))
    }

    /// The answer to a question that every supported Home Assistant knows.
    fn ask_surely(&mut self, question: &'static str, more: Value) -> Result<Value, RegistriesError> {
        match self.ask(question, more)? {
            Answer::Result(result) => Ok(result),
            Answer::Unknown => Err(RegistriesError::Question {
                version: self.version.clone(),
                question,
                fault: "it does not know this question".to_owned(),
            }),
        }
    }

    /// The entities with their device classes, which the list alone lacks.
    fn entities(&mut self) -> Result<Value, RegistriesError> {
        const GET: &str = "config/entity_registry/get_entries";
        let mut entities = self.ask_surely("config/entity_registry/list", json!({}))?;
        let Some(list) = entities.as_array_mut() else { return Err(self.foreign("its list of entities is none")) };
        for some in list.chunks_mut(ENTITIES_AT_ONCE) {
            let ids: Vec<&Value> = some.iter().map(|entity| &entity["entity_id"]).collect();
            let mut whole = match self.ask(GET, json!({ "entity_ids": ids }))? {
                Answer::Result(whole) => whole,
                // Before 2023.2 the states have the device classes.
                Answer::Unknown => return self.entities_by_state(entities),
            };
            for entity in some {
                let id = entity["entity_id"].as_str().unwrap_or_default().to_owned();
                match whole.get_mut(&id) {
                    Some(more) if more.is_object() => *entity = more.take(),
                    _ => {}
                }
            }
        }
        Ok(entities)
    }

    fn entities_by_state(&mut self, mut entities: Value) -> Result<Value, RegistriesError> {
        let states = self.ask_surely("get_states", json!({}))?;
        let states = states.as_array().map(Vec::as_slice).unwrap_or_default();
        let kinds: std::collections::HashMap<&str, &Value> = (states.iter())
            .filter_map(|state| Some((state["entity_id"].as_str()?, state["attributes"].get("device_class")?)))
            .collect();
        for entity in entities.as_array_mut().into_iter().flatten() {
            let kind = entity["entity_id"].as_str().and_then(|id| kinds.get(id).copied().cloned());
            if let (Some(kind), Some(entity)) = (kind, entity.as_object_mut()) {
                entity.insert("original_device_class".to_owned(), kind);
            }
        }
        Ok(entities)
    }

    fn fetch(&mut self) -> Result<Fetched, RegistriesError> {
        let as_file = |key: &str, list: Value| json!({ "data": { key: list } }).to_string();
        let areas = as_file("areas", self.ask_surely("config/area_registry/list", json!({}))?);
        let floors = match self.ask("config/floor_registry/list", json!({}))? {
            Answer::Result(floors) => Some(as_file("floors", floors)),
            Answer::Unknown => None,
        };
        let devices = as_file("devices", self.ask_surely("config/device_registry/list", json!({}))?);
        let entities = as_file("entities", self.entities()?);
        let persons = match self.ask("person/list", json!({}))? {
            Answer::Result(mut persons) => Some(as_file("items", persons["storage"].take())),
            Answer::Unknown => None,
        };
        Ok(Fetched { version: self.version.clone(), areas, floors, devices, entities, persons })
    }
}

/// An untrusted text on one line, short enough for an error.
fn plain(text: &str) -> String {
    const LONGEST: usize = 200;
    text.chars().filter(|c| !c.is_control() && !roomcast_core::text::is_hidden(*c)).take(LONGEST).collect()
}

/// Checks an address without connecting.
///
/// # Errors
///
/// [`RegistriesError::Address`].
pub fn check_address(url: &str) -> Result<(), RegistriesError> {
    Address::parse(url).map(|_| ())
}

/// Reads the registries of the Home Assistant at `url`.
///
/// # Errors
///
/// [`RegistriesError`], each with a remedy.
pub fn fetch(url: &str, token_file: &Path, authority: Option<&Path>) -> Result<Fetched, RegistriesError> {
    let address = Address::parse(url)?;
    let token = read_token(token_file)?;
    let tls = address.secure.then(|| tls(authority)).transpose()?;
    let mut connection = Connection::open(&address, &token, token_file, tls)?;
    let fetched = connection.fetch()?;
    // The server may have closed already; the data is complete.
    let _closed = connection.socket.close(None);
    Ok(fetched)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::BufRead;
    use std::net::TcpListener;
    use std::thread::JoinHandle;

    fn token_file(folder: &tempfile::TempDir, text: &str, mode: u32) -> PathBuf {
        let path = folder.path().join("token");
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
        path
    }

    /// A read timeout must not look like an interruption, which the handshake would report in its own words.
    #[test]
    fn a_host_that_says_nothing_took_too_long() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let stream = TcpStream::connect(address).unwrap();
        let stream = Timed { stream, until: Instant::now() + Duration::from_millis(50) };
        let refused = client_with_config(format!("ws://{address}/"), stream, None).err().unwrap();
        let HandshakeError::Failure(SocketError::Io(error)) = refused else { panic!("{refused:?}") };
        assert_eq!((error.kind(), error.to_string()), (io::ErrorKind::TimedOut, "it took longer than 60 s".to_owned()));
    }

    /// Answers one connection as Home Assistant does. `answer` maps a question to its answer; `None` means an unknown question.
    fn server(answer: impl Fn(&Value) -> Option<Value> + Send + 'static) -> (String, JoinHandle<()>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let serve = move || {
            let (stream, _) = listener.accept().unwrap();
            let Ok(mut socket) = tungstenite::accept(stream) else { return };
            let say = |socket: &mut WebSocket<TcpStream>, value: Value| {
                let _gone = socket.send(Message::text(value.to_string()));
            };
            say(&mut socket, json!({"type": "auth_required", "ha_version": "2024.3.3"}));
            while let Ok(message) = socket.read() {
                let Message::Text(text) = message else { continue };
                let question: Value = serde_json::from_str(&text).unwrap();
                if question["type"] == "auth" {
                    let good = question["access_token"] == "good";
                    let invalid = json!({"type": "auth_invalid", "message": "Invalid access token or password"});
                    say(&mut socket, if good { json!({"type": "auth_ok"}) } else { invalid });
                    continue;
                }
                // Other messages may come between.
                say(&mut socket, json!({"id": 9999, "type": "event"}));
                let unknown =
                    json!({"success": false, "error": {"code": "unknown_command", "message": "Unknown command."}});
                let mut said = answer(&question).unwrap_or(unknown);
                (said["id"], said["type"]) = (question["id"].clone(), "result".into());
                say(&mut socket, said);
            }
        };
        (url, std::thread::spawn(serve))
    }

    fn home(question: &Value) -> Option<Value> {
        let result = match question["type"].as_str()? {
            "config/area_registry/list" => json!([{"area_id": "kitchen", "name": "Kitchen", "aliases": []}]),
            "config/device_registry/list" => json!([]),
            "config/entity_registry/list" => {
                json!([{"entity_id": "binary_sensor.fridge", "area_id": "kitchen", "unique_id": "1"}])
            }
            "config/entity_registry/get_entries" => json!({"binary_sensor.fridge": {
                "entity_id": "binary_sensor.fridge", "area_id": "kitchen", "original_device_class": "door", "unique_id": "1"}}),
            "get_states" => json!([{"entity_id": "binary_sensor.fridge", "attributes": {"device_class": "door"}}]),
            "person/list" => json!({"storage": [{"id": "p", "name": "Ada"}], "config": []}),
            _ => return None,
        };
        Some(json!({"success": true, "result": result}))
    }

    fn rules(fetched: &Fetched) -> String {
        roomcast_core::semantic_map::import::home_assistant(&fetched.registries(), "home").unwrap().rules.unwrap()
    }

    #[test]
    fn addresses_are_what_a_browser_opens() {
        for (given, url) in [
            ("http://homeassistant.local:8123", "ws://homeassistant.local:8123/api/websocket"),
            ("http://ha.lan", "ws://ha.lan:8123/api/websocket"),
            ("https://ha.example/", "wss://ha.example:443/api/websocket"),
            ("ws://127.0.0.1:1/api/websocket", "ws://127.0.0.1:1/api/websocket"),
            ("https://ha.example/proxy", "wss://ha.example:443/proxy/api/websocket"),
            ("http://[::1]:8123", "ws://[::1]:8123/api/websocket"),
        ] {
            assert_eq!(Address::parse(given).unwrap().url(), url);
        }
        for wrong in
            ["ha.lan", "mqtt://x", "http://", "http://:1", "http://a b", "http://u:p@h", "http://h:x", "http://h/?a"]
        {
            assert!(Address::parse(wrong).unwrap_err().to_string().contains("what a browser opens it with"), "{wrong}");
        }
    }

    #[test]
    fn a_token_is_its_owners_alone() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(read_token(&token_file(&folder, "abc.def\n", 0o600)).unwrap(), "abc.def");
        let fault = |text: &str, mode| read_token(&token_file(&folder, text, mode)).unwrap_err().to_string();
        assert!(fault("abc", 0o644).contains("chmod 600"));
        assert!(fault("abc", 0o640).contains("others may read it"));
        for text in ["", "two words", &"x".repeat(5000)] {
            assert!(fault(text, 0o600).contains("holds no token"), "{text:.20}");
        }
        let missing = read_token(&folder.path().join("none")).unwrap_err().to_string();
        assert!(missing.contains("write the token alone into this file"), "{missing}");
        assert!(read_token(folder.path()).unwrap_err().to_string().contains("no plain file"));
    }

    #[test]
    fn registries_come_as_their_files_have_them() {
        let folder = tempfile::tempdir().unwrap();
        let token = token_file(&folder, "good\n", 0o600);
        let (url, served) = server(home);
        let fetched = fetch(&url, &token, None).unwrap();
        served.join().unwrap();
        assert_eq!((fetched.version.as_str(), &fetched.floors), ("2024.3.3", &None));
        assert!(rules(&fetched).contains("They open the fridge.") && rules(&fetched).contains("Ada"));
        // An older one has the kinds in its states.
        let old =
            |question: &Value| home(question).filter(|_| question["type"] != "config/entity_registry/get_entries");
        let (url, _) = server(old);
        assert_eq!(rules(&fetch(&url, &token, None).unwrap()), rules(&fetched));
    }

    #[test]
    fn what_fails_says_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let (good, bad) = (token_file(&folder, "good", 0o600), folder.path().join("bad"));
        std::fs::copy(&good, &bad).unwrap();
        std::fs::write(&bad, "bad").unwrap();
        let fault = |url: &str, token: &Path| fetch(url, token, None).unwrap_err().to_string();
        let refused = fault(&server(home).0, &bad);
        assert!(refused.contains("refuses the token (Invalid access token or password)"), "{refused}");
        assert!(refused.contains("long-lived access token"), "{refused}");
        let nobody = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let gone = fault(&format!("http://{nobody}"), &good);
        assert!(gone.contains("cannot be reached") && gone.contains("8123 by default"), "{gone}");
        let unknown = fault("http://no-such-host.invalid", &good);
        assert!(
            unknown.contains("no host \"no-such-host.invalid\" is known") && unknown.contains("give its number"),
            "{unknown}"
        );
        let old = fault(&server(|_| None).0, &good);
        assert!(old.contains("config/area_registry/list") && old.contains("update Home Assistant"), "{old}");
        let guest =
            |_: &Value| Some(json!({"success": false, "error": {"code": "unauthorized", "message": "Unauthorized"}}));
        let guest = fault(&server(guest).0, &good);
        assert!(guest.contains("unauthorized") && guest.contains("as an administrator"), "{guest}");
    }

    fn plain_server(answer: &'static [u8]) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut lines = io::BufReader::new(stream.try_clone().unwrap()).lines();
            while lines.next().is_some_and(|line| line.is_ok_and(|line| !line.is_empty())) {}
            stream.write_all(answer).unwrap();
        });
        url
    }

    #[test]
    fn another_server_is_no_home_assistant() {
        let folder = tempfile::tempdir().unwrap();
        let token = token_file(&folder, "good", 0o600);
        for answer in [&b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"[..], b"SSH-2.0-OpenSSH_9.2\r\n"] {
            let fault = fetch(&plain_server(answer), &token, None).unwrap_err().to_string();
            assert!(fault.contains("is no Home Assistant"), "{fault}");
        }
        let fault = fetch(&plain_server(b""), &token, None).unwrap_err().to_string();
        assert!(fault.contains("127.0.0.1"), "{fault}");
        // A server without TLS.
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let secure = format!("https://{}", listener.local_addr().unwrap());
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let _read = stream.read(&mut [0; 1024]);
            stream.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n").unwrap();
        });
        let fault = fetch(&secure, &token, None).unwrap_err().to_string();
        assert!(fault.contains("nobody speaks https at this port"), "{fault}");
    }
}
