//! Where a person will be at now + t: room scores, the present room and the length of stays, combined.
//!
//! The room scores S give the room of the *next object*, not the time of the move. A planner needs the probability p_r(t) that room r is occupied a
//! time t from now. It mixes three estimates, each valid for a while:
//!
//! ```text
//! p(t) = A(t) b + (1 - A(t)) (B(t) S + (1 - B(t)) q)
//!
//! b     the person's present room: filtered from the mentioned things and their rooms
//! S     the room of the next object: the partitions' probabilities, with like things weighted by `like_things.rs`
//! q     the person's room in the long run: time spent so far, over an even prior
//! A(t)  probability that the person has not turned to the next object by then
//! B(t)  probability that the following stay has not ended by then
//! ```
//!
//! An interval of more than twelve hours between two observations does not count as time spent. An absence of more than a day and a half does not
//! count as an absence.
//!
//! A and B are survival functions of stays with memory (a semi-Markov prior): a person who has sat for a long time will probably stay seated. Both
//! are Lomax, `((m + age) / (m + age + t))^2` with mean `m` at age 0, the shape of an exponential with an uncertain rate. `m` is learned from the
//! observed intervals, over a prior worth a few of them. Silence ages a stay as much as events do, except for the length of one action, which is
//! observed only when complete. If an observation after a rest (more than ten minutes with one thing) names another thing, the person has turned to
//! it at least as probably as a person without history. A rest is not an interval to learn from.
//!
//! A sensor reports a room, but no thing. A later sentence is about the next thing, because no thing in hand is known. The next thing begins another
//! stay with the ratio of the two prior means as its probability. The room of that stay is unknown, so every room is equally likely. Without this,
//! the earlier sensor event would outweigh the later and more specific sentence.
//!
//! Besides the rooms there is one more place, elsewhere: the person is out of the house. After a departure the person is certainly elsewhere, and
//! returns by a survival function of the same shape, with the mean of the observed absences over a prior of hours. A predicted return leads to the
//! long-run rooms. An observed return starts at the way into the house, or in any room if the map has no way in. A person in the house is not
//! elsewhere at any horizon: departures are not predicted.
//!
//! To follow a person, call [`Forecaster::come_in_by`], [`Forecaster::observe`], [`Forecaster::enter`], [`Forecaster::leave`] and
//! [`Forecaster::expect`], and read [`Forecaster::at`] and [`Forecaster::elsewhere`].
//!
//! Pure: time comes in with the calls.

use crate::grounding::{GroundedScores, Grounding, relative_to_largest};
use crate::like_things::InUse;
use crate::places::{Mention, evenness};

/// Assumptions of the forecast before it has observed the home.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ForecastOptions {
    /// Mean time from one object to the next, in seconds.
    pub object_s: f64,
    /// Mean stay in a room, in seconds.
    pub stay_s: f64,
    /// Shortest time of an action, in seconds: events that a camera reports at one instant happened one after the other.
    pub action_s: f64,
    /// Number of observed intervals that the priors of the means are worth.
    pub strength: f64,
    /// Probability that the person is in a room without the mentioned thing, because the map lacks it there.
    pub misplaced: f64,
    /// Probability that a reported room is wrong.
    pub mistaken: f64,
    /// Mean time out of the house, in seconds.
    pub away_s: f64,
    /// Share of a label's probability that its things share evenly; near and recently used things get the rest. 1 is Equation 2.
    pub any_thing: f64,
}

impl Default for ForecastOptions {
    fn default() -> Self {
        Self {
            object_s: 40.0,
            stay_s: 120.0,
            action_s: 2.0,
            strength: 3.0,
            misplaced: 0.02,
            mistaken: 0.01,
            away_s: 4.0 * 3600.0,
            any_thing: 0.5,
        }
    }
}

impl ForecastOptions {
    /// Probability that the next thing belongs to another stay than the last one, for a person without history.
    fn moved(&self) -> f64 {
        let moved = self.object_s / self.stay_s;
        // However implausible the means, the earlier belief keeps at least half of its weight.
        if moved.is_nan() { 0.5 } else { moved.clamp(0.0, 0.5) }
    }
}

/// Longest action, in seconds. A longer interval is a rest, for example a night, and says nothing about the intervals between two rests.
const REST_S: f64 = 600.0;

/// Longest silence that counts as a stay, in seconds. A night is shorter; in a longer silence the person's room is unknown.
const SILENCE_S: f64 = 12.0 * 3_600.0;

/// Longest absence to learn from, in seconds. A longer one was a journey, or its start had a wrong date.
const JOURNEY_S: f64 = 36.0 * 3_600.0;

/// Probability that a person comes home by the map's way in. Otherwise they appear in any room, for example by another door.
const BY_THE_WAY_IN: f64 = 0.8;

/// Length of [`Forecaster::paces`].
pub const PACES: usize = 5;

/// A mean learned over a prior.
#[derive(Debug, Clone, Copy)]
struct Learned {
    total_s: f64,
    count: f64,
}

impl Learned {
    fn mean_s(self) -> f64 {
        (self.total_s / self.count).max(1e-3)
    }

    /// Adds an interval between two observations, unless it is a rest.
    fn add_pace(&mut self, interval_s: f64) {
        if interval_s <= REST_S {
            self.add(interval_s);
        }
    }

    fn add(&mut self, interval_s: f64) {
        self.total_s += interval_s;
        self.count += 1.0;
    }

    fn survival(self, age_s: f64, horizon_s: f64) -> f64 {
        let scale_s = self.mean_s() + age_s;
        (scale_s / (scale_s + horizon_s)).powi(2)
    }
}

/// A mean without observed intervals.
fn prior(mean_s: f64, strength: f64) -> Learned {
    Learned { total_s: mean_s * strength, count: strength }
}

/// The forecast of one person. The sum of several persons' probabilities is the expected number of people.
#[derive(Debug, Clone)]
pub struct Forecaster {
    options: ForecastOptions,
    belief: Vec<f64>,
    /// Scratch: the belief during an update.
    predicted: Vec<f64>,
    scores: Vec<f64>,
    in_use: InUse,
    /// Scratch for [`Forecaster::expect_next`].
    near: Vec<f64>,
    /// Number of the scores in use. `None` after an observation.
    expected: Option<u64>,
    /// The scores include the last event. False after a sensor has placed the person in another room.
    expects: bool,
    spent_s: Vec<f64>,
    to_object: Learned,
    stay: Learned,
    away: Learned,
    /// Probability per room that a person who comes home is there.
    way_in: Vec<f64>,
    /// When the person left the house; `None` if they are in.
    away_since_s: Option<f64>,
    /// When the person turned to the object in hand.
    object_since_s: f64,
    object: Option<usize>,
    /// When the person entered the likeliest room.
    room_since_s: f64,
    updated_s: f64,
    /// The last news of the person's room came from a sensor, and no action is known since.
    sensed: bool,
    /// Belief of the joint filter, which replaces `belief` ([`Forecaster::track`]): per room if the person is in, and the probability of being out.
    tracked: Vec<f64>,
    tracked_out: Option<f64>,
}

impl Forecaster {
    /// A forecaster without knowledge: all `rooms` are equally likely at `now_s`.
    #[must_use]
    pub fn new(rooms: usize, options: ForecastOptions, now_s: f64) -> Self {
        let even = vec![1.0 / rooms.max(1) as f64; rooms];
        let prior = |mean_s: f64| prior(mean_s, options.strength);
        Self {
            options,
            spent_s: even.iter().map(|p| p * options.stay_s).collect(),
            belief: even.clone(),
            predicted: even.clone(),
            way_in: even.clone(),
            scores: even,
            in_use: InUse::default(),
            near: Vec::with_capacity(rooms),
            expected: None,
            expects: true,
            to_object: prior(options.object_s),
            stay: prior(options.stay_s),
            away: prior(options.away_s),
            away_since_s: None,
            object_since_s: now_s,
            object: None,
            room_since_s: now_s,
            updated_s: now_s,
            sensed: false,
            tracked: Vec::with_capacity(rooms),
            tracked_out: None,
        }
    }

    /// Copies the forecast of `own`, with the joint filter's belief about the present instead: `p` per room, and `out` for being out of the house.
    /// Stays, scores and the long run are those of `own`. If `p` has another number of rooms, the belief is unchanged.
    pub fn track(&mut self, own: &Self, p: impl ExactSizeIterator<Item = f64>, out: f64) {
        self.clone_from(own);
        if p.len() != self.belief.len() || !out.is_finite() {
            return;
        }
        self.tracked.clear();
        self.tracked.extend(p.map(|p| p.max(0.0)));
        let total: f64 = self.tracked.iter().sum();
        if total > 0.0 {
            self.tracked.iter_mut().for_each(|p| *p /= total);
        } else {
            self.tracked.copy_from_slice(&self.belief);
        }
        self.tracked_out = Some(out.clamp(0.0, 1.0));
    }

    /// Whether the joint filter gives the belief ([`Forecaster::track`]).
    #[must_use]
    pub fn is_tracked(&self) -> bool {
        self.tracked_out.is_some()
    }

    fn out(&self) -> f64 {
        self.tracked_out.unwrap_or(if self.away_since_s.is_some() { 1.0 } else { 0.0 })
    }

    /// Probability that the object in hand, and so the room, is still the same at `now_s + horizon_s`.
    #[must_use]
    pub fn stays(&self, now_s: f64, horizon_s: f64) -> f64 {
        let (age_s, horizon_s) = self.ages(now_s, horizon_s);
        self.to_object.survival(age_s, horizon_s)
    }

    /// Age of the object in hand, and the horizon counted from its last sign, in seconds.
    fn ages(&self, now_s: f64, horizon_s: f64) -> (f64, f64) {
        // Silence is evidence that nothing else was done, except for its last part: an action may still be in progress. That part belongs to the
        // horizon.
        let silence_s = (now_s - self.updated_s).max(0.0);
        // The joint filter's belief is about now.
        let hidden_s = if self.is_tracked() { 0.0 } else { silence_s.min(self.to_object.mean_s()) };
        (self.updated_s + silence_s - hidden_s - self.object_since_s, horizon_s.max(0.0) + hidden_s)
    }

    /// Sets the way into the house: weights per room. If they are all 0 or of another length, a person who comes home may be in any room.
    pub fn come_in_by(&mut self, ways: &[f64]) {
        let rooms = self.belief.len();
        let even = 1.0 / rooms.max(1) as f64;
        let total: f64 = ways.iter().sum();
        let is_known = ways.len() == rooms && total.is_finite() && total > 0.0;
        let share = |way: &f64| BY_THE_WAY_IN * way / total + (1.0 - BY_THE_WAY_IN) * even;
        self.way_in.clear();
        match is_known {
            true => self.way_in.extend(ways.iter().map(share)),
            false => self.way_in.resize(rooms, even),
        }
    }

    /// The person's room probabilities now. For a person out of the house, those before they left.
    #[must_use]
    pub fn belief(&self) -> &[f64] {
        if self.is_tracked() { &self.tracked } else { &self.belief }
    }

    /// Processes an action completed at `at_s`: the thing it mentions, if any, and the model's room probabilities afterwards. Earlier times count as
    /// the time of the last observation; scores of another length are ignored. The person is then in the house.
    pub fn observe(&mut self, at_s: f64, mention: Option<Mention>, grounding: &Grounding, scores: &[f64]) {
        let rooms = self.belief.len();
        // A sentence from before the sensor's event says nothing about the time after it.
        let is_late = at_s < self.updated_s;
        let at_s = self.come_home(at_s);
        let mentioned =
            mention.filter(|mention| mention.label < grounding.weights.rows() && grounding.weights.columns() == rooms);
        // P(label | room) is proportional to the share of the label's items there.
        let misplaced = self.options.misplaced;
        let moved = if self.sensed && !is_late { self.options.moved() } else { 0.0 };
        let weigh = |mention: Mention, room: usize, p: f64| {
            let p = (1.0 - moved) * p + moved / rooms as f64;
            let share = mention.share(grounding, room);
            let fits = if mention.is_left { 1.0 - share } else { share };
            p * (misplaced / rooms as f64 + (1.0 - misplaced) * fits)
        };
        // Turning to another thing after a rest, or leaving a room, ends the previous stay.
        let rested = at_s - self.object_since_s > REST_S;
        let turns = rested && mentioned.is_some_and(|mention| mention.is_left || self.object != Some(mention.label));
        let same_at_most = if turns { self.newcomer(at_s) } else { 1.0 };
        let observed = mentioned.map(|mention| {
            move |belief: &mut [f64]| {
                belief.iter_mut().enumerate().for_each(|(room, p)| *p = weigh(mention, room, *p));
            }
        });
        self.update(at_s, same_at_most, observed);
        self.sensed &= mentioned.is_none();
        // A room or thing that is left is not in use.
        (self.expects, self.expected) = (true, None);
        if rested {
            self.in_use.clear();
        }
        if let Some(label) = mentioned.filter(|mention| !mention.is_left).map(|mention| mention.label) {
            self.in_use.turn_to(label, &self.belief);
            if self.object != Some(label) {
                self.to_object.add_pace((at_s - self.object_since_s).max(self.options.action_s));
                self.object_since_s = at_s;
                self.object = Some(label);
            }
        }
        self.expect(scores);
    }

    /// As [`Forecaster::observe`], for a text that names no place, with the likelihood of the text in each room.
    pub fn suppose(&mut self, at_s: f64, likelihood: &[f64]) {
        /// Probability that the text is about another room than the model's.
        const MISREAD: f64 = 0.01;
        /// Probability that the belief lost the person, if the text fits one room only.
        const LOST: f64 = 0.1;
        let at_s = self.come_home(at_s);
        let total: f64 = likelihood.iter().sum();
        if likelihood.len() != self.belief.len() || !(total.is_finite() && total > 0.0) {
            return;
        }
        let before = likeliest(&self.belief);
        let lost = LOST * (1.0 - evenness(likelihood));
        let even = 1.0 / likelihood.len() as f64;
        let read = |belief: &mut [f64]| {
            for (p, fits) in belief.iter_mut().zip(likelihood) {
                let share = fits / total;
                *p = ((1.0 - lost) * *p + lost * share) * ((1.0 - MISREAD) * share + MISREAD * even);
            }
        };
        self.update(at_s, 1.0, Some(read));
        (self.expects, self.expected) = (true, None);
        if at_s - self.object_since_s > REST_S {
            self.in_use.clear();
        }
        if likeliest(&self.belief) != before {
            // The thing in hand is in another room.
            (self.object, self.object_since_s) = (None, at_s);
        }
    }

    /// Processes a report, such as a sensor's, that the person is in the house at `at_s`, and in `room` if given. The person is then in that room,
    /// except with probability [`ForecastOptions::mistaken`], whatever the belief was. A report older than the last observation is ignored. Returns
    /// whether it was used.
    pub fn enter(&mut self, at_s: f64, room: Option<usize>) -> bool {
        self.enter_any(at_s, |other| Some(other) == room)
    }

    /// As [`Forecaster::enter`] for a set of rooms. The relative probabilities within the set do not change.
    pub fn enter_any(&mut self, at_s: f64, is_meant: impl Fn(usize) -> bool) -> bool {
        /// No room of the set is impossible.
        const LEAST: f64 = 1e-3;
        let rooms = self.belief.len();
        if self.away_since_s.is_none() && at_s < self.updated_s {
            return false;
        }
        let at_s = self.come_home(at_s);
        if !(0..rooms).any(&is_meant) {
            return true;
        }
        self.sensed = true;
        let before = likeliest(&self.belief);
        let mistaken = self.options.mistaken;
        let seen = |belief: &mut [f64]| {
            let of_meant: f64 =
                belief.iter().enumerate().filter(|(room, _)| is_meant(*room)).map(|(_, p)| p + LEAST).sum();
            for (room, p) in belief.iter_mut().enumerate() {
                let share = if is_meant(room) { (*p + LEAST) / of_meant } else { 0.0 };
                *p = mistaken * *p + (1.0 - mistaken) * share;
            }
        };
        self.update(at_s, 1.0, Some(seen));
        if likeliest(&self.belief) != before {
            self.begin_elsewhere(at_s);
        }
        true
    }

    /// Resets the object in hand and the scores, because both belong to another room.
    fn begin_elsewhere(&mut self, at_s: f64) {
        (self.object, self.object_since_s) = (None, at_s);
        self.scores.copy_from_slice(&self.belief);
        (self.expected, self.expects, self.sensed) = (None, false, true);
    }

    /// Processes a report that `room` is empty at `at_s`. It does not count as a sign of the person. If the person was believed to be there, they
    /// have moved on; otherwise the silence continues. A report older than the last observation is ignored.
    pub fn exclude(&mut self, at_s: f64, room: usize) {
        // A person out of the house is in no room anyway.
        if self.away_since_s.is_some() || at_s < self.updated_s || room >= self.belief.len() {
            return;
        }
        let mistaken = self.options.mistaken;
        // The room keeps only the probability of a wrong report, however sure the belief was. The other rooms keep their ratios.
        let left = |p: f64| mistaken * p * (1.0 - p) / (1.0 - mistaken * p).max(f64::MIN_POSITIVE);
        let empty = |belief: &mut [f64]| belief[room] = left(belief[room]);
        let before = likeliest(&self.belief);
        if before != Some(room) {
            self.belief[room] = left(self.belief[room]);
            let total: f64 = self.belief.iter().sum();
            self.belief.iter_mut().for_each(|p| *p /= total);
            return;
        }
        self.update(at_s, 1.0, Some(empty));
        if likeliest(&self.belief) != before {
            self.begin_elsewhere(at_s);
        }
    }

    /// Processes a report that the person is out of the house from `at_s` on.
    pub fn leave(&mut self, at_s: f64) {
        if self.away_since_s.is_some() {
            return;
        }
        let at_s = at_s.max(self.updated_s);
        self.spend(at_s);
        (self.away_since_s, self.updated_s) = (Some(at_s), at_s);
    }

    /// If the person was out, places them at the way in and not in their long-run rooms, such as the bedroom. Returns `at_s`, or the time of the last
    /// observation if later.
    fn come_home(&mut self, at_s: f64) -> f64 {
        let at_s = at_s.max(self.updated_s);
        if let Some(since_s) = self.away_since_s.take() {
            if at_s - since_s <= JOURNEY_S {
                self.away.add((at_s - since_s).max(self.options.action_s));
            }
            self.belief.copy_from_slice(&self.way_in);
            self.begin_elsewhere(at_s);
            self.in_use.clear();
            (self.room_since_s, self.updated_s) = (at_s, at_s);
        }
        at_s
    }

    /// Adds the time since the last observation to the time spent per room, unless it was too long a silence.
    fn spend(&mut self, at_s: f64) {
        let elapsed_s = at_s - self.updated_s;
        if elapsed_s > SILENCE_S {
            return;
        }
        for (spent, p) in self.spent_s.iter_mut().zip(&self.belief) {
            *spent += p * elapsed_s;
        }
    }

    /// `at_s`, or the end of the shortest action after the last observation.
    fn one_action_on(&self, at_s: f64) -> f64 {
        at_s.max(self.updated_s + self.options.action_s)
    }

    /// Probability that a person without earlier history has not turned to the next object by `at_s`.
    fn newcomer(&self, at_s: f64) -> f64 {
        let object_s = self.options.object_s;
        prior(object_s, self.options.strength).survival(0.0, (self.one_action_on(at_s) - self.updated_s).min(object_s))
    }

    /// Advances the belief to `at_s` and applies `observed`, which scales room probabilities by a likelihood. `same_at_most` caps the probability
    /// that the object in hand is still the same.
    fn update(&mut self, at_s: f64, same_at_most: f64, observed: Option<impl Fn(&mut [f64])>) {
        let before = likeliest(&self.belief);
        self.spend(at_s);
        if let Some(observed) = observed {
            let mut predicted = std::mem::take(&mut self.predicted);
            predicted.clear();
            // Without a minimum duration, the later of two simultaneous events would have little effect.
            let (out, belief) = (self.out(), self.belief());
            predicted.extend(self.ahead((self.one_action_on(at_s), 0.0), same_at_most, out, |room| belief[room]));
            observed(&mut predicted);
            let total: f64 = predicted.iter().sum();
            if total > 0.0 {
                predicted.iter_mut().for_each(|p| *p /= total);
                std::mem::swap(&mut self.belief, &mut predicted);
            }
            self.predicted = predicted;
        }
        if likeliest(&self.belief) != before {
            self.stay.add_pace((at_s - self.room_since_s).max(self.options.action_s));
            self.room_since_s = at_s;
        }
        self.updated_s = at_s;
    }

    /// Sets the model's room probabilities after the last observation. They are ignored if they have another length, or if a sensor has placed the
    /// person in another room since their last action.
    pub fn expect(&mut self, scores: &[f64]) {
        if self.expects && scores.len() == self.scores.len() {
            self.scores.copy_from_slice(scores);
        }
    }

    /// As [`Forecaster::expect`], from `ln s_c` per label in nats. Like things are weighted by the person's present room and the things they used
    /// recently. `trust`, 0 to 1, is their weight; the rest is the present room. Scores of the same `number` are used once after each observation, so
    /// that after a restart, which restores the expectation and not the scores, the result is the same.
    pub fn expect_next(&mut self, grounding: &Grounding, label_log_prob_nats: &[f64], trust: f64, number: u64) {
        let mut relative = Vec::new();
        relative_to_largest(label_log_prob_nats, &mut relative);
        self.expect_by_label(grounding, &relative, trust, number);
    }

    /// As [`Forecaster::expect_next`], from grounded scores.
    pub fn expect_grounded(&mut self, grounding: &Grounding, scores: &GroundedScores, trust: f64, number: u64) {
        self.expect_by_label(grounding, &scores.relative, trust, number);
    }

    fn expect_by_label(&mut self, grounding: &Grounding, by_label: &[f64], trust: f64, number: u64) {
        let shape = (grounding.weights.rows(), grounding.weights.columns());
        let fits = shape == (by_label.len(), self.scores.len());
        if !self.expects || !fits || self.expected == Some(number) {
            return;
        }
        self.expected = Some(number);
        let (belief, in_use) = (&self.belief, (&self.in_use, self.options.any_thing));
        grounding.like_things.next_rooms(by_label, belief, in_use, &mut self.near, &mut self.scores);
        self.scores.iter_mut().zip(belief).for_each(|(score, here)| *score = trust * *score + (1.0 - trust) * here);
    }

    /// For the last observation: seconds since the person turned to the object in hand; then total seconds and count of the intervals between
    /// objects, and total seconds and count of the stays in rooms.
    #[must_use]
    pub fn paces(&self) -> [f64; PACES] {
        let Self { to_object, stay, .. } = self;
        [self.updated_s - self.object_since_s, to_object.total_s, to_object.count, stay.total_s, stay.count]
    }

    /// Restores a belief and [`Forecaster::paces`] of the last observation, for a person who was not out of the house. A belief of another length is
    /// ignored.
    pub fn believe(&mut self, belief: &[f64], paces: [f64; PACES]) {
        let total: f64 = belief.iter().sum();
        if self.away_since_s.is_some() || belief.len() != self.belief.len() || total <= 0.0 {
            return;
        }
        self.belief.clear();
        self.belief.extend(belief.iter().map(|p| p / total));
        let [held_s, object_s, objects, stays_s, stays] = paces;
        self.object_since_s = self.updated_s - held_s;
        self.to_object = Learned { total_s: object_s, count: objects };
        self.stay = Learned { total_s: stays_s, count: stays };
        if !self.expects {
            self.scores.copy_from_slice(&self.belief);
        }
    }

    /// Ends the window of narration: earlier use of things no longer affects the forecast.
    pub fn end_window(&mut self) {
        self.in_use.clear();
    }

    /// Adopts another list of labels. `new` gives the new index of each old label; the rooms are unchanged.
    pub fn relabel(&mut self, new: &dyn Fn(usize) -> Option<usize>) {
        self.in_use.relabel(new);
        self.object = self.object.and_then(new);
    }

    /// Adopts a map with other rooms: `new` gives the new index of each old room, `rooms` their new number. New rooms get no belief. The way in is
    /// reset; call [`Forecaster::come_in_by`].
    pub fn take_rooms(&mut self, new: &[Option<usize>], rooms: usize) {
        let even = 1.0 / rooms.max(1) as f64;
        let moved = |old: &[f64]| {
            let mut own = vec![0.0; rooms];
            for (room, p) in new.iter().zip(old) {
                if let Some(own) = room.and_then(|room| own.get_mut(room)) {
                    *own += p;
                }
            }
            own
        };
        let distribution = |old: &[f64]| {
            let mut own = moved(old);
            let total: f64 = own.iter().sum();
            own.iter_mut().for_each(|p| *p = if total > 0.0 { *p / total } else { even });
            own
        };
        (self.belief, self.scores) = (distribution(&self.belief), distribution(&self.scores));
        let known: Vec<usize> = new.iter().flatten().copied().collect();
        self.spent_s = moved(&self.spent_s);
        let fresh = |room: &usize| !known.contains(room);
        (0..rooms).filter(fresh).for_each(|room| self.spent_s[room] = even * self.options.stay_s);
        self.come_in_by(&[]);
        // It refers to the old rooms.
        self.in_use.clear();
    }

    /// Probability per room that the next thing is there. `None` after a sensor has placed the person in another room.
    #[must_use]
    pub fn expected(&self) -> Option<&[f64]> {
        self.expects.then_some(&self.scores)
    }

    /// Probability per room that the person is there at `now_s + horizon_s`. The sum with [`Forecaster::elsewhere`] is one.
    pub fn at(&self, now_s: f64, horizon_s: f64) -> impl ExactSizeIterator<Item = f64> {
        let belief = self.belief();
        self.ahead((now_s, horizon_s), 1.0, self.out(), |room| belief[room])
    }

    /// Writes the forecast per room, elsewhere last, of a person who surely is in a room for which `is_there` holds, or elsewhere if it holds for
    /// `None`. Returns the probability of that; if it is zero, the whole belief counts.
    pub fn write_given(
        &self,
        (now_s, horizon_s): (f64, f64),
        is_there: impl Fn(Option<usize>) -> bool,
        row: &mut [f64],
    ) -> f64 {
        let (belief, out) = (self.belief(), self.out());
        let share = |room: usize| if is_there(Some(room)) { belief[room] } else { 0.0 };
        let inside: f64 = (0..belief.len()).map(share).sum();
        let [out_there, in_there] = [if is_there(None) { out } else { 0.0 }, (1.0 - out) * inside];
        let total = out_there + in_there;
        let is_possible = total > 0.0;
        let out = if is_possible { out_there / total } else { out };
        let given = |room| if is_possible { share(room) / inside.max(f64::MIN_POSITIVE) } else { belief[room] };
        if let Some((elsewhere, rooms)) = row.split_last_mut() {
            rooms.fill(0.0);
            rooms.iter_mut().zip(self.ahead((now_s, horizon_s), 1.0, out, given)).for_each(|(p, own)| *p = own);
            *elsewhere = self.still_out(out, now_s, horizon_s);
        }
        total
    }

    /// As [`Self::at`], with a cap on the probability that the object in hand is still the same, for a belief.
    fn ahead(
        &self,
        (now_s, horizon_s): (f64, f64),
        same_at_most: f64,
        out: f64,
        belief: impl Fn(usize) -> f64,
    ) -> impl ExactSizeIterator<Item = f64> {
        let back = out - self.still_out(out, now_s, horizon_s);
        let (object_age_s, horizon_s) = self.ages(now_s, horizon_s);
        let same_object = self.to_object.survival(object_age_s, horizon_s).min(same_at_most);
        let same_stay = self.stay.survival(0.0, horizon_s);
        let spent_s: f64 = self.spent_s.iter().sum();
        (0..self.belief.len()).map(move |room| {
            let long_run = self.spent_s[room] / spent_s;
            let after = same_stay * self.scores[room] + (1.0 - same_stay) * long_run;
            let here = same_object * belief(room) + (1.0 - same_object) * after;
            back * long_run + (1.0 - out) * here
        })
    }

    /// Probability that the person is out of the house at `now_s + horizon_s`.
    #[must_use]
    pub fn elsewhere(&self, now_s: f64, horizon_s: f64) -> f64 {
        self.still_out(self.out(), now_s, horizon_s)
    }

    /// The same for a person who is out now with this probability.
    fn still_out(&self, out: f64, now_s: f64, horizon_s: f64) -> f64 {
        let gone_s = self.away_since_s.map_or(0.0, |since_s| (now_s - since_s).max(0.0));
        match out {
            0.0 => 0.0,
            out => out * self.away.survival(gone_s, horizon_s.max(0.0)),
        }
    }

    /// Expected time of the person per room between `from_s` and `to_s` after `now_s`, in seconds.
    #[must_use]
    pub fn expected_s(&self, now_s: f64, from_s: f64, to_s: f64) -> Vec<f64> {
        /// Enough, because probabilities change slowly.
        const SAMPLES: usize = 8;
        let width_s = (to_s - from_s).max(0.0) / SAMPLES as f64;
        let mut expected = vec![0.0; self.belief.len()];
        for sample in 0..SAMPLES {
            let at = self.at(now_s, from_s + (sample as f64 + 0.5) * width_s);
            expected.iter_mut().zip(at).for_each(|(sum, p)| *sum += p * width_s);
        }
        expected
    }
}

fn likeliest(p: &[f64]) -> Option<usize> {
    (0..p.len()).max_by(|a, b| p[*a].total_cmp(&p[*b]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::GroundingOptions;
    use crate::places::PlaceMatcher;
    use crate::semantic_map::SemanticMap;
    use proptest::prelude::*;

    fn studio() -> (SemanticMap, Grounding) {
        let map = SemanticMap::from_json(include_str!("../../scenes/studio.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        (map, grounding)
    }

    /// A silent weekend, and an event with a wrong date, do not add weeks to a room.
    #[test]
    fn a_long_silence_is_no_stay_and_a_journey_no_absence() {
        const H: f64 = 3_600.0;
        let options = ForecastOptions { stay_s: 1_200.0, ..ForecastOptions::default() };
        let after = |silence_s: f64| {
            let mut own = Forecaster::new(3, options, 0.0);
            own.enter(0.0, Some(0));
            (0..36).for_each(|turn| {
                own.enter(silence_s + 600.0 * f64::from(turn), Some(1 + turn as usize % 2));
            });
            own.at(silence_s + 6.0 * H, H).next().unwrap()
        };
        for silence_s in [64.0 * H, 504.0 * H, 1e9] {
            assert!(after(silence_s) < 0.1, "{silence_s} {}", after(silence_s));
        }
        assert!(after(11.0 * H) > 0.3, "a night is a stay: {}", after(11.0 * H));

        let back_after = |absence_s: f64| {
            let mut own = Forecaster::new(3, options, 0.0);
            own.leave(10.0);
            own.enter(10.0 + absence_s, Some(0));
            own.leave(1e9 + H);
            own.elsewhere(1e9 + H, 4.0 * H)
        };
        assert!((back_after(H) - back_after(504.0 * H)).abs() < 0.1, "{} {}", back_after(H), back_after(504.0 * H));
    }

    /// Among like things in several rooms, the one in the person's room counts; this stays so until the next observation.
    #[test]
    fn like_things_are_told_apart_once_after_each_observation() {
        let map = SemanticMap::from_json(include_str!("../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let rooms = grounding.partitions.len();
        let has = |label: usize, room: usize| grounding.weights[(label, room)] > 0.0;
        let labels = grounding.scored_labels.len();
        let even = |label: &usize| (0..rooms).filter(|room| grounding.weights[(*label, *room)] == 0.5).count() == 2;
        let spread = (0..labels).find(even).unwrap();
        let of: Vec<usize> = (0..rooms).filter(|room| has(spread, *room)).collect();
        let (first, second) = (of[0], of[1]);
        let only_in = |room: usize| {
            (0..labels).find(|label| (0..rooms).all(|other| has(*label, other) == (other == room))).unwrap()
        };
        let nats: Vec<f64> = (0..labels).map(|label| if label == spread { 0.0 } else { f64::NEG_INFINITY }).collect();
        let mut forecaster = Forecaster::new(rooms, ForecastOptions::default(), 0.0);
        let likeliest_next = |forecaster: &mut Forecaster, number: u64| {
            forecaster.expect_next(&grounding, &nats, 1.0, number);
            likeliest(forecaster.expected().unwrap()).unwrap()
        };
        forecaster.observe(10.0, Some(only_in(first).into()), &grounding, &[]);
        assert_eq!(likeliest_next(&mut forecaster, 1), first);
        let before = forecaster.expected().unwrap().to_vec();
        // A report about a third room changes the belief a little; the same scores give the same expectation.
        if let Some(third) = (0..rooms).find(|room| ![first, second].contains(room)) {
            forecaster.exclude(11.0, third);
            forecaster.expect_next(&grounding, &nats, 1.0, 1);
            assert_eq!(forecaster.expected(), Some(&before[..]));
        }
        // The thing in use stays the one turned to, until the person has rested or the window ends.
        forecaster.observe(20.0, Some(spread.into()), &grounding, &[]);
        forecaster.observe(30.0, Some(only_in(second).into()), &grounding, &[]);
        assert_eq!(likeliest_next(&mut forecaster, 2), first);
        let mut ended = forecaster.clone();
        ended.end_window();
        assert_eq!(likeliest_next(&mut ended, 3), second);
        forecaster.observe(30.0 + 2.0 * REST_S, Some(only_in(second).into()), &grounding, &[]);
        assert_eq!(likeliest_next(&mut forecaster, 3), second);
    }

    #[test]
    fn it_moves_from_the_present_room_over_the_scores_to_the_long_run() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let room = |id: &str| grounding.partitions.iter().position(|p| p.id == id).unwrap();
        let (kitchen, main) = (room("kitchen"), room("main-room"));
        let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
        let mut scores = [0.05; 3];
        scores[main] = 0.9;
        forecaster.observe(10.0, mentions.last("They open the fridge."), &grounding, &scores);
        let at = |t: f64| forecaster.at(10.0, t).collect::<Vec<_>>();
        assert!(at(0.0)[kitchen] > 0.9, "{:?}", at(0.0));
        assert!(at(100.0)[main] > at(0.0)[main] && at(100.0)[main] > at(100.0)[kitchen], "{:?}", at(100.0));
        assert!(at(1e5).iter().all(|p| (0.1..0.8).contains(p)), "{:?}", at(1e5));
        let spent = forecaster.expected_s(10.0, 20.0, 60.0);
        assert!((spent.iter().sum::<f64>() - 40.0).abs() < 1e-9);
    }

    /// Sentences at one instant count in sequence: the last one gives the room.
    #[test]
    fn what_is_told_at_once_was_done_one_after_the_other() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let room = |id: &str| grounding.partitions.iter().position(|p| p.id == id).unwrap();
        let told = ["They open the fridge.", "They grab the milk.", "They walk to the sofa.", "They sit on the sofa."];
        let mut after = |apart_s: f64| {
            let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
            let mut at_s = 10.0;
            for sentence in told {
                forecaster.observe(at_s, mentions.last(sentence), &grounding, &[1.0 / 3.0; 3]);
                at_s += apart_s;
            }
            forecaster.belief()[room("main-room")]
        };
        let (burst, apart) = (after(0.0), after(3.0));
        assert!(burst > 0.8 && apart > 0.8, "{burst} at one instant, {apart} with 3 s between them");
    }

    #[test]
    fn who_has_stayed_long_stays_on() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let bed = mentions.last("They lie on the bed.");
        let mut short = Forecaster::new(3, ForecastOptions::default(), 0.0);
        short.observe(5.0, bed, &grounding, &[1.0 / 3.0; 3]);
        let mut long = short.clone();
        long.observe(3000.0, bed, &grounding, &[1.0 / 3.0; 3]);
        let here = likeliest(short.belief()).unwrap();
        assert!(long.at(3000.0, 60.0).nth(here) > short.at(5.0, 60.0).nth(here));
    }

    /// A night is not a pace: afterwards the forecast follows events as quickly as without it.
    #[test]
    fn after_a_night_the_forecast_follows_as_without_it() {
        let map = SemanticMap::from_json(include_str!("../../scenes/ward.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let rooms = grounding.partitions.len();
        // Things that exist in one room only, one thing per room.
        let mut things: Vec<(usize, usize)> = Vec::new();
        for label in 0..grounding.scored_labels.len() {
            let room = (0..rooms).find(|room| grounding.weights[(label, *room)] > 0.99);
            if let Some(room) = room.filter(|room| things.iter().all(|(_, other)| other != room)) {
                things.push((label, room));
            }
        }
        assert!(rooms >= 6 && things.len() >= 5, "{rooms} rooms, {} things", things.len());
        let even = vec![1.0 / rooms as f64; rooms];
        let told = |night_s: f64, apart_s: f64| {
            let mut forecaster = Forecaster::new(rooms, ForecastOptions::default(), 0.0);
            let mut at_s = 10.0;
            forecaster.observe(at_s, Some(things[0].0.into()), &grounding, &even);
            at_s += night_s;
            let mut believed = Vec::new();
            for (label, room) in &things[1..] {
                at_s += apart_s;
                forecaster.observe(at_s, Some((*label).into()), &grounding, &even);
                believed.push(forecaster.at(at_s, 0.0).nth(*room).unwrap());
            }
            let last = things.last().unwrap().1;
            (believed, forecaster.at(at_s, 60.0).nth(last).unwrap())
        };
        for apart_s in [3.0, 20.0, 60.0] {
            let (awake, awake_later) = told(0.0, apart_s);
            for night_s in [1200.0, 2.0 * 3600.0, 8.0 * 3600.0] {
                let (slept, slept_later) = told(night_s, apart_s);
                for (slept, awake) in slept.iter().zip(&awake) {
                    assert!(*slept > 0.9 * awake, "{night_s} s, {apart_s} s apart: {slept} without the night {awake}");
                }
                if night_s > REST_S {
                    assert!((slept_later - awake_later).abs() < 0.15, "{night_s}: {slept_later}, {awake_later}");
                }
            }
        }
        // A person leaves the room they slept in: they are in another.
        let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
        let (map, grounding) = studio();
        let mut studio = PlaceMatcher::new(&map, &grounding);
        forecaster.observe(10.0, studio.last("They walk to the kitchen."), &grounding, &[1.0 / 3.0; 3]);
        forecaster.observe(28_800.0, studio.last("They leave the kitchen."), &grounding, &[1.0 / 3.0; 3]);
        let kitchen = grounding.partitions.iter().position(|p| p.id == "kitchen").unwrap();
        assert!(forecaster.belief()[kitchen] < 0.1, "{:?}", forecaster.belief());
    }

    /// A person out of the house is in no room and returns within hours; sooner if past absences were short.
    #[test]
    fn who_has_left_is_elsewhere_and_comes_back() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let bed = mentions.last("They lie on the bed.");
        let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
        forecaster.observe(5.0, bed, &grounding, &[1.0 / 3.0; 3]);
        assert_eq!(forecaster.elsewhere(5.0, 3600.0), 0.0);
        forecaster.leave(100.0);
        forecaster.leave(200.0);
        let rooms = |forecaster: &Forecaster, now_s: f64, t: f64| forecaster.at(now_s, t).sum::<f64>();
        assert_eq!((forecaster.elsewhere(100.0, 0.0), rooms(&forecaster, 100.0, 0.0)), (1.0, 0.0));
        let hours = |count: f64| forecaster.elsewhere(100.0, count * 3600.0);
        assert!(hours(1.0) > 0.6 && hours(4.0) < 0.3 && hours(100.0) < 0.01, "{} {}", hours(1.0), hours(4.0));
        // After a long absence the remaining absence is longer, too.
        assert_eq!(forecaster.elsewhere(50_000.0, 0.0), 1.0);
        assert!(forecaster.elsewhere(50_000.0, 3600.0) > hours(1.0));
        let mut quick = forecaster.clone();
        let mut at_s = 100.0;
        for _ in 0..10 {
            quick.enter(at_s + 300.0, None);
            assert_eq!(quick.elsewhere(at_s + 300.0, 1e6), 0.0);
            at_s += 1000.0;
            quick.leave(at_s);
        }
        assert!(quick.elsewhere(at_s, 3600.0) < hours(1.0));
        // Back, in an unknown room; an action gives the room.
        forecaster.enter(4000.0, None);
        assert!((rooms(&forecaster, 4000.0, 0.0) - 1.0).abs() < 1e-9);
        assert_eq!(forecaster.belief(), [1.0 / 3.0; 3]);
        forecaster.leave(4100.0);
        forecaster.observe(5000.0, bed, &grounding, &[]);
        assert!(forecaster.at(5000.0, 0.0).fold(0.0, f64::max) > 0.8);
    }

    /// A person does not come home into the bed in which they spend their nights.
    #[test]
    fn who_comes_home_is_at_the_way_in() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
        forecaster.observe(5.0, mentions.last("They lie on the bed."), &grounding, &[1.0 / 3.0; 3]);
        let bed = likeliest(forecaster.belief()).unwrap();
        let hall = (bed + 1) % 3;
        let mut ways = [0.0; 3];
        ways[hall] = 0.5;
        forecaster.come_in_by(&ways);
        forecaster.leave(30_000.0);
        assert!(forecaster.at(30_000.0, 1e6).nth(bed).unwrap() > 0.9, "in the long run in bed");
        for (name, told) in [("present", None), ("a room that the map lacks", Some(7))] {
            let mut back = forecaster.clone();
            back.enter(60_000.0, told);
            assert!(back.belief()[hall] > 0.8 && back.belief()[bed] < 0.1, "{name}: {:?}", back.belief());
            let soon: Vec<f64> = back.at(60_000.0, 30.0).collect();
            assert_eq!(likeliest(&soon), Some(hall), "{name}: {soon:?}");
        }
        // The way in of another map is unknown.
        let mut changed = forecaster.clone();
        changed.take_rooms(&[Some(0), Some(1), Some(2)], 4);
        changed.enter(60_000.0, None);
        assert_eq!(changed.belief(), [0.25; 4]);
        changed.leave(60_001.0);
        changed.come_in_by(&[0.0, 0.0, 0.0, 1.0]);
        changed.enter(60_002.0, None);
        assert_eq!(likeliest(changed.belief()), Some(3));
        // A reported room takes precedence.
        forecaster.enter(60_000.0, Some(bed));
        assert!(forecaster.belief()[bed] > 0.98);
    }

    #[test]
    fn a_sensor_says_where_somebody_is() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
        forecaster.observe(5.0, mentions.last("They lie on the bed."), &grounding, &[1.0 / 3.0; 3]);
        let bed = likeliest(forecaster.belief()).unwrap();
        for room in (0..3).filter(|room| *room != bed) {
            let mut seen = forecaster.clone();
            seen.enter(6.0, Some(room));
            assert!(seen.belief()[room] > 0.98, "{:?}", seen.belief());
            // Scores from before the report do not draw the person back.
            seen.expect(&std::array::from_fn::<_, 3, _>(|other| f64::from(u8::from(other == bed))));
            let after = |t: f64| seen.at(6.0 + t, 0.0).collect::<Vec<_>>();
            let course: Vec<f64> = [1.0, 5.0, 15.0, 40.0, 180.0].iter().map(|t| after(*t)[room]).collect();
            assert!(course.iter().all(|p| *p > 0.7) && course[2] > 0.85, "{course:?}");
            seen.enter(61.0, Some(7));
            assert!(seen.belief()[room] > 0.9, "no such room");
        }
    }

    /// Motion in the doorway and then a device: a sentence after a sensor's event is the person's next action, however soon.
    #[test]
    fn a_sentence_or_a_sensor_after_a_sensor_says_where_somebody_is() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let room = |id: &str| grounding.partitions.iter().position(|p| p.id == id).unwrap();
        let (kitchen, bathroom) = (room("kitchen"), room("bathroom"));
        let even = [1.0 / 3.0; 3];
        let fridge = mentions.last("They open the fridge.");
        let goes = mentions.last("They go to the bathroom.");
        let leaves = mentions.last("They leave the kitchen.");
        let fresh = Forecaster::new(3, ForecastOptions::default(), 0.0);
        // A sensor that agrees with the actions does not make it harder to leave.
        let mut cooking = fresh.clone();
        for at_s in [20.0, 50.0, 80.0] {
            cooking.observe(at_s, fridge, &grounding, &even);
        }
        let mut home = fresh.clone();
        home.leave(20.0);
        for (name, before) in [("fresh", &fresh), ("cooking", &cooking), ("back home", &home)] {
            for apart_s in [0.5, 1.0, 2.0, 3.0, 5.0, 10.0] {
                let what = format!("{name}, {apart_s} s");
                let mut seen = before.clone();
                seen.enter(100.0, Some(kitchen));
                let mut told = seen.clone();
                told.observe(100.0 + apart_s, goes, &grounding, &even);
                assert!(told.belief()[bathroom] > 0.9, "{what}: {:?}", told.belief());
                let later: Vec<f64> = told.at(160.0 + apart_s, 0.0).collect();
                assert_eq!(likeliest(&later), Some(bathroom), "{what}: {later:?}");
                let mut left = seen.clone();
                left.observe(100.0 + apart_s, leaves, &grounding, &even);
                assert!(left.belief()[kitchen] < 0.1, "{what}: {:?}", left.belief());
                let mut walked = seen.clone();
                walked.enter(100.0 + apart_s, Some(bathroom));
                assert!(walked.belief()[bathroom] > 0.98, "{what}: {:?}", walked.belief());
                // An action in the same room, or a sentence without a thing, does not move the person.
                for mention in [fridge, None] {
                    let mut stays = seen.clone();
                    stays.observe(100.0 + apart_s, mention, &grounding, &even);
                    assert!(stays.belief()[kitchen] > 0.95, "{what}: {:?}", stays.belief());
                    stays.observe(101.0 + apart_s, goes, &grounding, &even);
                    assert!(mention.is_some() || stays.belief()[bathroom] > 0.9, "{what}: {:?}", stays.belief());
                }
            }
        }
        // A sentence from before the sensor's event says nothing about the time after it.
        let mut late = fresh.clone();
        late.enter(100.0, Some(kitchen));
        late.observe(97.0, goes, &grounding, &even);
        assert_eq!(likeliest(late.belief()), Some(kitchen), "{:?}", late.belief());
    }

    /// After a report that a room is empty, the other rooms keep their ratios.
    #[test]
    fn nobody_is_in_an_empty_room() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
        forecaster.observe(5.0, mentions.last("They lie on the bed."), &grounding, &[1.0 / 3.0; 3]);
        let bed = likeliest(forecaster.belief()).unwrap();
        let mut elsewhere = forecaster.clone();
        forecaster.exclude(6.0, bed);
        assert!(forecaster.belief()[bed] < 0.011, "{:?}", forecaster.belief());
        elsewhere.exclude(6.0, (bed + 1) % 3);
        assert_eq!(likeliest(elsewhere.belief()), Some(bed));
        elsewhere.exclude(6.0, 7);
        elsewhere.leave(7.0);
        let away = elsewhere.clone();
        elsewhere.exclude(8.0, bed);
        assert_eq!(elsewhere.at(9.0, 60.0).collect::<Vec<_>>(), away.at(9.0, 60.0).collect::<Vec<_>>());
    }

    /// An occupancy sensor that reports another room as empty every ten seconds does not move the person.
    #[test]
    fn of_who_is_in_another_room_an_empty_one_says_nothing() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let mut silent = Forecaster::new(3, ForecastOptions::default(), 0.0);
        silent.observe(5.0, mentions.last("They lie on the bed."), &grounding, &[1.0 / 3.0; 3]);
        let bed = likeliest(silent.belief()).unwrap();
        let mut told = silent.clone();
        for at_s in (15..605).step_by(10) {
            told.exclude(f64::from(at_s), (bed + 1) % 3);
        }
        let here = |own: &Forecaster, horizon_s: f64| own.at(605.0, horizon_s).nth(bed).unwrap();
        for horizon_s in [0.0, 60.0, 900.0] {
            let (silent, told) = (here(&silent, horizon_s), here(&told, horizon_s));
            assert!(told >= silent && told < silent + 0.05, "{silent} {told} {horizon_s} s ahead");
        }
    }

    #[test]
    fn a_room_more_moves_nobody() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let mut own = Forecaster::new(3, ForecastOptions::default(), 0.0);
        own.observe(5.0, mentions.last("They lie on the bed."), &grounding, &[0.2, 0.3, 0.5]);
        let (before, scores) = (own.belief().to_vec(), own.expected().unwrap().to_vec());
        own.take_rooms(&[Some(2), Some(0), Some(3)], 4);
        assert_eq!(own.belief(), [before[1], 0.0, before[0], before[2]]);
        assert_eq!(own.expected().unwrap(), [scores[1], 0.0, scores[0], scores[2]]);
        assert!((own.at(6.0, 900.0).sum::<f64>() - 1.0).abs() < 1e-9 && own.at(6.0, 900.0).nth(1).unwrap() > 0.0);
        // If no belief remains, all rooms are equally likely.
        own.take_rooms(&[None; 4], 2);
        assert_eq!(own.belief(), [0.5, 0.5]);
    }

    /// Leaving a room excludes it; leaving or putting down a thing in a room does not.
    #[test]
    fn who_leaves_a_room_is_in_another() {
        let (map, grounding) = studio();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let room = |id: &str| grounding.partitions.iter().position(|p| p.id == id).unwrap();
        for sentence in ["They leave the kitchen.", "Ada exits the kitchen", "They walk out of the kitchen."] {
            let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
            forecaster.observe(5.0, mentions.last("They open the fridge."), &grounding, &[1.0 / 3.0; 3]);
            assert!(forecaster.belief()[room("kitchen")] > 0.9);
            forecaster.observe(9.0, mentions.last(sentence), &grounding, &[0.05, 0.9, 0.05]);
            assert!(forecaster.belief()[room("kitchen")] < 0.1, "{sentence} {:?}", forecaster.belief());
        }
        let is_left = |mentions: &mut PlaceMatcher, sentence: &str| mentions.last(sentence).unwrap().is_left;
        for sentence in ["They leave the mug in the kitchen.", "They walk to the kitchen."] {
            assert!(!is_left(&mut mentions, sentence), "{sentence}");
        }
    }

    proptest! {
        /// Rooms and elsewhere sum to one at every horizon. A person who never left is never elsewhere.
        #[test]
        fn a_person_is_in_a_room_or_elsewhere(
            events in prop::collection::vec((-5.0..9000.0f64, 0usize..5, 0usize..60), 0..30),
            wait_s in 0.0..1e5f64,
        ) {
            let (_, grounding) = studio();
            let mut forecaster = Forecaster::new(3, ForecastOptions::default(), 0.0);
            let (mut now_s, mut left, mut out) = (0.0, false, false);
            for (pause_s, what, which) in events {
                now_s += pause_s;
                match what {
                    0 => forecaster.leave(now_s),
                    1 => _ = forecaster.enter(now_s, None),
                    2 => _ = forecaster.enter(now_s, Some(which % 4)),
                    4 => forecaster.exclude(now_s, which % 4),
                    _ => forecaster.observe(now_s, Some(which.into()), &grounding, &[0.2, 0.8, 0.0]),
                }
                left |= what == 0;
                let mut before = 1.0;
                for horizon_s in [0.0, 30.0, 3600.0, 1e6] {
                    let elsewhere = forecaster.elsewhere(now_s + wait_s, horizon_s);
                    let rooms: Vec<f64> = forecaster.at(now_s + wait_s, horizon_s).collect();
                    prop_assert!((rooms.iter().sum::<f64>() + elsewhere - 1.0).abs() < 1e-9);
                    prop_assert!(rooms.iter().chain([&elsewhere]).all(|p| (0.0..=1.0 + 1e-12).contains(p)));
                    prop_assert!(elsewhere <= before && (left || elsewhere == 0.0));
                    before = elsewhere;
                    // The forecast is the mean of the forecasts from each place.
                    let mut mean = [0.0; 4];
                    for place in (0..3).map(Some).chain([None]) {
                        let mut row = [0.0; 4];
                        let p = forecaster.write_given((now_s + wait_s, horizon_s), |other| other == place, &mut row);
                        prop_assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-9);
                        mean.iter_mut().zip(row).for_each(|(sum, own)| *sum += p * own);
                    }
                    let all = rooms.iter().chain([&elsewhere]);
                    prop_assert!(all.zip(mean).all(|(p, mean)| (p - mean).abs() < 1e-9), "{rooms:?} {mean:?}");
                }
                out = what == 0 || out && what == 4;
                prop_assert_eq!(forecaster.elsewhere(now_s, 0.0), f64::from(u8::from(out)));
            }
        }
    }
}
