//! Removes services without participants. The last participant removes its service when it leaves, but may be killed while it does.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use iceoryx2::prelude::{CallbackProgression, Service};
use iceoryx2::service::builder::event::EventOpenError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::builder::request_response::RequestResponseOpenError;
use iceoryx2::service::ipc_threadsafe::Service as Flavour;
use iceoryx2::service::marker::{CustomHeaderMarker, CustomPayloadMarker};
use iceoryx2::service::static_config::StaticConfig;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern;

/// Services seen without participants, with their file and the time since when. This state is normal for moments, while a service is
/// created or left.
#[derive(Debug, Default)]
pub(crate) struct Unused {
    seen: BTreeMap<PathBuf, (File, Instant)>,
    /// The modification times of the folders of participants and services at the last look.
    changed: [Option<SystemTime>; 2],
}

/// Inode number and change time: a new service of the same name has another one.
type File = (u64, i64);

#[derive(Debug)]
enum Rest {
    /// The service has no memory: its creator failed or was killed between file and memory, or the last participant could remove only the
    /// memory. iceoryx2 treats it as unfinished and rejects all participants.
    File,
    Whole(Box<StaticConfig>),
}

impl Unused {
    /// Whether a look may find something new: each participant that joins, leaves or is cleaned up changes one of the folders.
    pub(crate) fn is_due(&mut self, changed: [Option<SystemTime>; 2]) -> bool {
        let before = std::mem::replace(&mut self.changed, changed);
        before != changed || !self.seen.is_empty()
    }

    /// Removes services that are older than `long` and have been without participants for a quarter of that. `age` gives the age of a file;
    /// the files are in `folder` and begin with `prefix`. Returns the name endings of the memory files of closed services: they have no
    /// participants, and the next look removes the rest of them.
    pub(crate) fn remove(
        &mut self,
        node: &iceoryx2::node::Node<Flavour>,
        folder: &Path,
        prefix: &str,
        long: Duration,
        age: impl Fn(&Path) -> Option<Duration>,
    ) -> Vec<String> {
        let mut found = BTreeMap::new();
        // If the list fails, it has still named some services, and the next look goes on.
        let _listed = Flavour::list(node.config(), |details| {
            let service = details.static_details;
            let path = folder.join(format!("{prefix}{}.service", service.service_hash().as_str()));
            let rest = match details.dynamic_details {
                None => Some(Rest::File),
                Some(within) if within.nodes.is_empty() => Some(Rest::Whole(Box::new(service))),
                Some(_) => None,
            };
            if let (Some(rest), Ok(about)) = (rest, fs::metadata(&path)) {
                found.insert(path, ((about.ino(), about.ctime_nsec()), rest));
            }
            CallbackProgression::Continue
        });
        self.seen.retain(|path, (file, _)| found.get(path).is_some_and(|(found, _)| found == file));
        let mut closed = Vec::new();
        for (path, (file, rest)) in found {
            let (_, since) = self.seen.entry(path.clone()).or_insert((file, Instant::now()));
            // A service is without participants for moments while it is created or left.
            if since.elapsed() < long / 4 || age(&path).is_none_or(|age| age < long) {
                continue;
            }
            match rest {
                Rest::File => {
                    // Another participant may remove it at the same moment, so an error is ignored.
                    let _removed = fs::remove_file(path);
                }
                // A participant may join at this moment. So iceoryx2 removes the service: the last participant that leaves closes it first.
                Rest::Whole(service) => {
                    if is_closed_or_leave(node, &service) {
                        // The domain's prefix and the type's prefix precede the service's number.
                        closed.push(format!("_{}.dynamic", service.unique_service_id().value()));
                    }
                }
            }
        }
        closed
    }
}

/// Joins a service of any type and leaves it at once. Returns whether the service is closed to all participants. Other errors pass, or the
/// participant that needs the service reports them.
#[expect(
    unsafe_code,
    reason = "iceoryx2 has no other way to open a service whose type is not known when this is compiled"
)]
fn is_closed_or_leave(node: &iceoryx2::node::Node<Flavour>, service: &StaticConfig) -> bool {
    let builder = node.service_builder(service.name());
    match service.messaging_pattern() {
        MessagingPattern::Event(_) => matches!(builder.event().open(), Err(EventOpenError::IsMarkedForDestruction)),
        MessagingPattern::PublishSubscribe(about) => {
            let types = about.message_type_details();
            let builder = builder.publish_subscribe::<[CustomPayloadMarker]>().user_header::<CustomHeaderMarker>();
            // SAFETY: the types are those of the service. Without a port, no data is read as any type.
            let builder = unsafe {
                builder
                    .__internal_set_payload_type_details(&types.payload)
                    .__internal_set_user_header_type_details(&types.user_header)
            };
            matches!(builder.open(), Err(PublishSubscribeOpenError::IsMarkedForDestruction))
        }
        MessagingPattern::RequestResponse(about) => {
            let (request, response) = (about.request_message_type_details(), about.response_message_type_details());
            let builder = builder
                .request_response::<[CustomPayloadMarker], [CustomPayloadMarker]>()
                .request_user_header::<CustomHeaderMarker>()
                .response_user_header::<CustomHeaderMarker>();
            // SAFETY: as above.
            let builder = unsafe {
                builder
                    .__internal_set_request_payload_type_details(&request.payload)
                    .__internal_set_response_payload_type_details(&response.payload)
                    .__internal_set_request_header_type_details(&request.user_header)
                    .__internal_set_response_header_type_details(&response.user_header)
            };
            matches!(builder.open(), Err(RequestResponseOpenError::IsMarkedForDestruction))
        }
        // Roomcast has no other patterns.
        _ => false,
    }
}
