//! Shared by the commands that speak MQTT: the broker, and the exit codes of its errors.

use std::path::PathBuf;

use roomcast_services::config::MqttConfig;
use roomcast_services::mqtt::{Broker, MqttError};

use super::Failure;

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The broker, in place of the configuration's: `mqtt://HOST[:PORT]`, or `mqtts://HOST[:PORT]` with --mqtt-ca. The configuration's login and
    /// certificates are only for its own broker.
    #[arg(long, value_name = "URL")]
    mqtt: Option<String>,
    /// A file with the broker's user name and password, a line each.
    #[arg(long, value_name = "FILE")]
    mqtt_credentials: Option<PathBuf>,
    /// A PEM file with the certificates of the broker's certificate authority.
    #[arg(long, value_name = "FILE")]
    mqtt_ca: Option<PathBuf>,
}

impl Args {
    /// For a command that declares these options itself.
    pub fn of(mqtt: Option<String>, mqtt_credentials: Option<PathBuf>, mqtt_ca: Option<PathBuf>) -> Self {
        Self { mqtt, mqtt_credentials, mqtt_ca }
    }

    pub fn broker(&self, config: &MqttConfig, client: String) -> Result<Broker, Failure> {
        let Some(address) = self.mqtt.clone().or_else(|| config.broker.clone()) else {
            return Err(Failure::config(
                "no broker is named: set broker = \"mqtt://127.0.0.1\" in the section [mqtt], or give --mqtt",
            ));
        };
        // Files of the configuration belong to its broker.
        let own = self.mqtt.is_none();
        let configured = |path: &Option<PathBuf>| path.clone().filter(|_| own);
        let broker = Broker {
            address,
            client,
            credentials: self.mqtt_credentials.clone().or_else(|| configured(&config.credentials)),
            authority: self.mqtt_ca.clone().or_else(|| configured(&config.ca)),
        };
        match broker.options() {
            // The configured address is at fault. A CA file of the command line may not fit a configured address.
            Err(error @ (MqttError::Address { .. } | MqttError::Login)) if own => Err(Failure::config(error)),
            Err(error @ MqttError::Scheme { .. }) if own && self.mqtt_ca.is_none() => Err(Failure::config(error)),
            Err(error) => Err(failure(error)),
            Ok(_) => Ok(broker),
        }
    }
}

pub fn failure(error: MqttError) -> Failure {
    use MqttError::{Address, Authority, Credentials, Login, Read, Rules, Scheme};
    match error {
        Address { .. } | Login | Scheme { .. } => Failure::usage(error),
        Read { .. } | Credentials { .. } | Rules { .. } | Authority { .. } => Failure::input(error),
        _ => Failure::failed(error),
    }
}
