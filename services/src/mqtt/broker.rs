//! The address, the credentials and the certificates of a broker.

use std::path::PathBuf;

use roomcast_core::text::{is_hidden, read_at_most, read_text_at_most};
use rumqttc::v5::MqttOptions;
use rumqttc::{TlsConfiguration, Transport};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;

use super::{KEEP_ALIVE, MESSAGES_AHEAD_MAX, MqttError, PACKET_BYTES_MAX};
use crate::sensor_log::RULES_BYTES_MAX;

/// The broker keeps the session of this process while it is away: for ever, if it agrees.
const SESSION_EXPIRY_S: u32 = u32::MAX;

/// A broker and the client's login.
#[derive(Debug, Clone, Default)]
pub struct Broker {
    /// `mqtt://HOST[:PORT]` or `mqtts://HOST[:PORT]`.
    pub address: String,
    /// The client's name, which is the broker's key of the session.
    pub client: String,
    /// A file with user name and password on one line each.
    pub credentials: Option<PathBuf>,
    /// A PEM file with the certificates of the authority that signed the broker's; required for `mqtts`.
    pub authority: Option<PathBuf>,
}

impl Broker {
    /// The client's options, with the files read. It finds each fault of the set-up before a connection is made.
    ///
    /// # Errors
    ///
    /// [`MqttError`] for an address or a file that cannot be used.
    pub fn options(&self) -> Result<MqttOptions, MqttError> {
        let wrong = || MqttError::Address(self.address.clone());
        let (scheme, rest) = self.address.split_once("://").ok_or_else(wrong)?;
        let secure = match scheme {
            "mqtt" => false,
            "mqtts" => true,
            _ => return Err(wrong()),
        };
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        if rest.contains('@') {
            return Err(MqttError::Login);
        }
        // An IPv6 address is in brackets, and contains colons.
        let end = rest.rfind(']').map_or(0, |at| at + 1);
        let (host, port) = match rest[end..].rsplit_once(':') {
            Some((name, port)) => (&rest[..end + name.len()], port.parse().map_err(|_| wrong())?),
            None => (rest, if secure { 8883 } else { 1883 }),
        };
        let is_foreign = |c: char| is_hidden(c) || c.is_whitespace() || "/?#\\\"'<>,;".contains(c);
        if host.is_empty() || port == 0 || host.contains(is_foreign) || end == 0 && host.contains(':') {
            return Err(wrong());
        }
        let mut options = MqttOptions::new(&self.client, host, port);
        options.set_keep_alive(KEEP_ALIVE).set_clean_start(false);
        options.set_session_expiry_interval(Some(SESSION_EXPIRY_S));
        options.set_receive_maximum(Some(MESSAGES_AHEAD_MAX)).set_max_packet_size(Some(PACKET_BYTES_MAX));
        // The client allocates memory for this many, and publishes none.
        options.set_outgoing_inflight_upper_limit(MESSAGES_AHEAD_MAX);
        if let Some(path) = &self.credentials {
            let text =
                read_text_at_most(path, RULES_BYTES_MAX).map_err(|source| MqttError::Read(path.clone(), source))?;
            let mut lines = text.trim_start_matches('\u{feff}').lines();
            let (Some(user), Some(password)) = (lines.next().filter(|user| !user.is_empty()), lines.next()) else {
                return Err(MqttError::Credentials(path.clone()));
            };
            options.set_credentials(user, password);
        }
        match (&self.authority, secure) {
            (Some(path), true) => {
                let ca = read_at_most(path, RULES_BYTES_MAX)
                    .map_err(|source| MqttError::Read(path.clone(), source))?
                    .ok_or_else(|| MqttError::Authority(path.clone()))?;
                if !CertificateDer::pem_slice_iter(&ca).any(|certificate| certificate.is_ok()) {
                    return Err(MqttError::Authority(path.clone()));
                }
                // A second call finds one installed, which is fine.
                let _installed = rustls::crypto::ring::default_provider().install_default();
                options.set_transport(Transport::tls_with_config(TlsConfiguration::Simple {
                    ca,
                    alpn: None,
                    client_auth: None,
                }));
            }
            (None, false) => {}
            (authority, _) => {
                return Err(MqttError::Scheme(self.address.clone(), authority.is_some()));
            }
        }
        Ok(options)
    }
}

pub(super) fn address_remedy(given: &str) -> String {
    let remedy = "give mqtt://HOST[:PORT], or mqtts://HOST[:PORT] with a CA file";
    let meant = format!("mqtt://{given}");
    let meant = Broker { address: if given.contains(':') { meant } else { meant + ":1883" }, ..Broker::default() };
    // The most frequent mistake: the form of other programs.
    match (given.contains("://"), meant.options()) {
        (false, Ok(_)) => format!("{remedy}, here {}", meant.address),
        _ => remedy.to_owned(),
    }
}
