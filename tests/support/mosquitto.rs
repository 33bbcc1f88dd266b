//! A real broker for tests: mosquitto from Debian's package, on a free loopback port.

use std::path::Path;
use std::process::{Child, Command, Stdio};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Packet;
use rumqttc::v5::{Client, Event, MqttOptions};

use crate::eventually::eventually;
use crate::skipped::skipped;

pub(crate) const NO_BROKER: &str = "mosquitto is not installed (apt-get install mosquitto)";

pub(crate) const ANYBODY: &str = "allow_anonymous true";

pub(crate) fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

pub(crate) struct Mosquitto {
    child: Child,
    pub(crate) port: u16,
    folder: tempfile::TempDir,
}

impl Mosquitto {
    /// A broker for anybody, with its port; `None` with a report if mosquitto is missing.
    pub(crate) fn ready() -> Option<(Self, u16)> {
        let port = free_port();
        let broker = Self::start(port, tempfile::tempdir().unwrap(), ANYBODY);
        if broker.is_none() {
            skipped(NO_BROKER);
        }
        Some((broker?, port))
    }

    /// `access` is a part of mosquitto's configuration.
    pub(crate) fn start(port: u16, folder: tempfile::TempDir, access: &str) -> Option<Self> {
        let config = folder.path().join("mosquitto.conf");
        let text = format!(
            "listener {port} 127.0.0.1\n{access}\npersistence true\npersistence_location {}/\nautosave_interval 1000\nautosave_on_changes true\nmax_queued_messages 0\n",
            folder.path().display()
        );
        std::fs::write(&config, text).unwrap();
        // Debian's package installs it outside an ordinary user's PATH. Without `user root`, a broker started by root changes its user.
        let program =
            ["/usr/sbin/mosquitto", "/usr/bin/mosquitto"].into_iter().find(|path| Path::new(path).exists())?;
        std::fs::write(&config, std::fs::read_to_string(&config).unwrap() + "user root\n").unwrap();
        let mut command = Command::new(program);
        command.arg("-c").arg(&config).stdout(Stdio::null()).stderr(Stdio::null());
        let child = command.spawn().unwrap();
        eventually("mosquitto listens", || std::net::TcpStream::connect(("127.0.0.1", port)).ok());
        Some(Self { child, port, folder })
    }

    pub(crate) fn restart(mut self) -> Self {
        self.stop();
        let Self { port, .. } = self;
        let folder = std::mem::replace(&mut self.folder, tempfile::tempdir().unwrap());
        drop(self);
        Self::start(port, folder, ANYBODY).unwrap()
    }

    pub(crate) fn stop(&mut self) {
        // On SIGTERM mosquitto saves its sessions.
        let pid = rustix::process::Pid::from_child(&self.child);
        let _ended = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        let _waited = self.child.wait();
    }

    /// Publishes messages in order and waits for the broker's acknowledgement of all.
    pub(crate) fn publish(&self, messages: &[(&str, String, bool)]) {
        let mut options = MqttOptions::new("publisher", "127.0.0.1", self.port);
        options.set_max_packet_size(Some(64 << 20));
        let (client, mut connection) = Client::new(options, messages.len().max(1));
        // A broker that has just begun to listen may refuse its first clients.
        eventually("the publisher is connected", || {
            let event = connection.recv().unwrap();
            matches!(event, Ok(Event::Incoming(Packet::ConnAck(_)))).then_some(())
        });
        for (topic, payload, retain) in messages {
            client.try_publish(*topic, QoS::AtLeastOnce, *retain, payload.clone()).unwrap();
        }
        let mut acknowledged = 0;
        while acknowledged < messages.len() {
            if let Event::Incoming(Packet::PubAck(_)) = connection.recv().unwrap().unwrap() {
                acknowledged += 1;
            }
        }
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        self.stop();
    }
}
