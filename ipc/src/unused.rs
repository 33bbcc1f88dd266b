//! Services that nobody is in: whoever leaves last removes its service, and may be killed while it does.

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

/// Services that nobody is in, as far as they have been seen: which file each has, and since when nobody is in it. For moments this is
/// ordinary: a service is made, or left.
#[derive(Debug, Default)]
pub(crate) struct Unused {
    seen: BTreeMap<PathBuf, (File, Instant)>,
    /// When the folders of participants and services had last changed at the last look.
    changed: [Option<SystemTime>; 2],
}

/// Which file it is: its number, and when it was last changed. A service that is made again under its name has another one.
type File = (u64, i64);

/// What is removed of a service.
#[derive(Debug)]
enum Rest {
    /// It has no memory: its maker failed or was killed between file and memory, or who left last could remove the memory only. iceoryx2
    /// takes it for one that is being made, and lets nobody in.
    File,
    /// It has memory, and nobody is in it.
    Whole(Box<StaticConfig>),
}

impl Unused {
    /// Whether a look may find something new: who comes, leaves or is cleaned up after changes one of the folders.
    pub(crate) fn is_due(&mut self, changed: [Option<SystemTime>; 2]) -> bool {
        let before = std::mem::replace(&mut self.changed, changed);
        before != changed || !self.seen.is_empty()
    }

    /// Removes services of more than `long` that nobody has been in for a part of that; `age` is that of a file, and their files lie in
    /// `folder` and begin with `prefix`. Returns the endings of the memory files of those that are closed to everybody: nobody can be in them
    /// any more, and the next look removes what is left then.
    pub(crate) fn remove(
        &mut self,
        node: &iceoryx2::node::Node<Flavour>,
        folder: &Path,
        prefix: &str,
        long: Duration,
        age: impl Fn(&Path) -> Option<Duration>,
    ) -> Vec<String> {
        let mut found = BTreeMap::new();
        // A list that fails has named some, and the next one goes on.
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
            // Who makes a service has a part of it for moments, and so has who leaves it.
            if since.elapsed() < long / 4 || age(&path).is_none_or(|age| age < long) {
                continue;
            }
            match rest {
                Rest::File => {
                    // Others may do the same at this moment: what fails here has been done there.
                    let _removed = fs::remove_file(path);
                }
                // Somebody may join it at this moment, so that iceoryx2's own way is taken: whoever leaves as the last one closes it first.
                Rest::Whole(service) => {
                    if is_closed_or_leave(node, &service) {
                        // Before the service's number stand the domain's prefix and the type's.
                        closed.push(format!("_{}.dynamic", service.unique_service_id().value()));
                    }
                }
            }
        }
        closed
    }
}

/// Joins a service of whatever type and leaves it at once, unless it lets nobody in any more: gives whether that is so. What else keeps it out
/// passes, or is told to whoever needs the service.
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
            // SAFETY: the types are those of the service, and no port is made: nothing is read as any type.
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
        // Roomcast has none.
        _ => false,
    }
}
