//! Which decisions are new. A decision stays at its service, and may be sent again: a bridge to other robots does for each who joins.

use std::collections::BTreeMap;

use roomcast_ipc::DecisionV1;

/// Robots that are followed; of more, the one with the smallest number gives way.
const ROBOTS_MAX: usize = 64;

/// What a decision says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum News {
    /// It is one that was not heard before.
    Decision,
    /// The same decision holds in another way, as of a robot that is not heard any more.
    Change,
    /// Nothing.
    None,
}

/// The last decision of each robot: epoch, sequence and action.
#[derive(Debug, Default)]
pub struct Decided(BTreeMap<u64, (u64, u64, u32)>);

impl Decided {
    /// Takes a decision; what it says beyond the robot's last one.
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
    use roomcast_ipc::action;

    /// Each time that somebody joined or left, all robots' decisions counted once more.
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
