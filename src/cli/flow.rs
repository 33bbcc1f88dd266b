//! The ports of all messages in the order of the flow: narration comes before the scores that contain it.

use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, NarrationV1, PersonForecastsV1, PersonScoresV1, RobotReportV1, RoomScoresV1,
};
use roomcast_ipc::{IpcError, Node, Publisher, Subscriber};
use roomcast_services::recording::Recorded;

macro_rules! flow {
    ($($field:ident: $message:ident as $variant:ident, $subscribe:ident;)*) => {
        pub(super) struct Subscribers {
            $(pub(super) $field: Subscriber<$message>,)*
        }

        impl Subscribers {
            pub(super) fn open(node: &Node) -> Result<Self, IpcError> {
                Ok(Self { $($field: node.$subscribe()?,)* })
            }

            pub(super) fn news(&self) -> Result<Vec<Recorded>, IpcError> {
                let mut news = Vec::new();
                $(while let Some(message) = self.$field.receive()? {
                    news.push(Recorded::$variant(Box::new(message)));
                })*
                Ok(news)
            }

            pub(super) fn malformed(&self) -> u64 {
                [$(self.$field.malformed()),*].into_iter().sum()
            }
        }

        pub(super) struct Publishers {
            $($field: Option<Publisher<$message>>,)*
        }

        impl Publishers {
            /// Of narration alone, or of all messages.
            pub(super) fn open(node: &Node, all: bool) -> Result<Self, IpcError> {
                let wanted = |name: &str| all || name == "narration";
                Ok(Self { $($field: wanted(stringify!($field)).then(|| node.publisher()).transpose()?,)* })
            }

            /// Sends a message if it is among those to be sent.
            pub(super) fn send(&self, message: &Recorded) -> Result<bool, IpcError> {
                match message {
                    $(Recorded::$variant(message) => {
                        let sent = self.$field.as_ref().map(|publisher| publisher.send(message)).transpose()?;
                        Ok(sent.is_some())
                    })*
                }
            }

            pub(super) fn tick(&self) -> Result<(), IpcError> {
                $(self.$field.as_ref().map(Publisher::tick).transpose()?;)*
                Ok(())
            }
        }
    };
}

// Earlier narration does not belong to a recording: it may be of a person that was forgotten since, and a replay would restore the person.
flow! {
    narration: NarrationV1 as Narration, subscriber_from_now;
    scores: RoomScoresV1 as RoomScores, subscriber;
    persons: PersonScoresV1 as PersonScores, subscriber;
    forecast: ForecastV1 as Forecast, subscriber;
    person_forecasts: PersonForecastsV1 as PersonForecasts, subscriber;
    decisions: DecisionV1 as Decision, subscriber;
    reports: RobotReportV1 as RobotReport, subscriber;
}
