//! Recognises new decisions. Services and bridges send a decision again to each new subscriber.

use std::collections::BTreeMap;

use roomcast_ipc::raw::DecisionV1;

/// Most robots that are followed. If there are more, the one with the smallest number is dropped.
const ROBOTS_MAX: usize = 64;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum News {
    /// A new decision.
    Decision,
    /// The same decision with another action, for instance of a robot that has fallen silent.
    Change,
    None,
}

/// The last decision of each robot: epoch, sequence and action.
#[derive(Debug, Default)]
pub struct Decided(BTreeMap<u64, (u64, u64, u32)>);

impl Decided {
    pub fn take(&mut self, decision: &DecisionV1) -> News {
        let own = (decision.epoch, decision.sequence, decision.action);
        let news = match self.0.insert(decision.robot, own) {
            Some(last) if last == own => News::None,
            Some(last) if (last.0, last.1) == (own.0, own.1) => News::Change,
            _ => News::Decision,
        };
        if self.0.len() > ROBOTS_MAX {
            let first = self.0.keys().copied().find(|robot| *robot != decision.robot);
            first.iter().for_each(|robot| _ = self.0.remove(robot));
        }
        news
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::raw::action;

    /// Regression: whenever a subscriber joined or left, all robots' decisions counted again.
    #[test]
    fn a_decision_that_is_sent_again_is_no_news() {
        let mut decided = Decided::default();
        let of = |robot, sequence| DecisionV1 { robot, sequence, action: action::GO, ..Default::default() };
        for robot in 1..=10 {
            assert_eq!(decided.take(&of(robot, 1)), News::Decision);
        }
        for robot in (1..=10).chain(1..=10) {
            assert_eq!(decided.take(&of(robot, 1)), News::None);
        }
        let gone = DecisionV1 { action: action::PAUSE, ..of(3, 1) };
        assert_eq!([gone, gone, of(3, 1)].map(|one| decided.take(&one)), [News::Change, News::None, News::Change]);
        assert_eq!(decided.take(&of(3, 2)), News::Decision);
        assert_eq!(
            decided.take(&DecisionV1 { epoch: 9, ..of(3, 2) }),
            News::Decision,
            "of a planner that was started again"
        );
        (0..1000).for_each(|robot| _ = decided.take(&of(robot, 7)));
        assert_eq!(decided.0.len(), ROBOTS_MAX);
    }
}
