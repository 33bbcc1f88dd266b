/* Roomcast's contract between processes, made by cbindgen from the crate roomcast-ipc: `make c-header`. Do not edit.
 *
 * Monotonic nanoseconds (`*_ns`) are of CLOCK_BOOTTIME, which counts suspension; `*_unix_ns` is wall clock, for people. */

#ifndef ROOMCAST_H
#define ROOMCAST_H

#include <stdint.h>

// Bytes of a name in a message (room, item, label, policy), UTF-8, zero padded.
#define ROOMCAST_NAME_BYTES 48

// Most bytes of a narration's text.
#define ROOMCAST_NARRATION_TEXT_BYTES 1024

// Most persons that one narration may count.
#define ROOMCAST_COUNT_MAX 8

// A plain sentence from any captioning source: "They grab the mug."
#define ROOMCAST_NARRATION_KIND_SENTENCE 0

// An atomic action in VirtualHome's notation: [Grab] <mug> (1).
#define ROOMCAST_NARRATION_KIND_ACTION 1

// A device's state: "the oven is on".
#define ROOMCAST_NARRATION_KIND_DEVICE 2

// Where a person is, without an action that a language model could read: present, present in the kitchen, away, gone. Or
// the state of a sensor, as JSON.
#define ROOMCAST_NARRATION_KIND_PRESENCE 3

// Most rooms (partitions) in one message. A map with more cannot be served by the daemon.
#define ROOMCAST_MAX_ROOMS 64

// Most narrators named in one message; the longest silent ones are left out, and a flag says so.
#define ROOMCAST_MAX_SOURCES 16

// Value of RoomScoresV1::person: the message speaks of all persons together.
#define ROOMCAST_ALL_PERSONS UINT32_MAX

// Every label was scored; bounds equal scores.
#define ROOMCAST_REACHED_EXACT 0

// The ranking of the rooms is certain, the scores are bounds.
#define ROOMCAST_REACHED_RANKING 1

// The most likely room is certain.
#define ROOMCAST_REACHED_TOP 2

// Time ran out; the bounds hold the exact scores.
#define ROOMCAST_REACHED_DEADLINE 3

// Sent again unchanged, to say that the daemon lives: same sequence, newer published_ns.
#define ROOMCAST_SCORE_FLAGS_HEARTBEAT 1

// No narration yet: the scores are what the model says about an unknown past.
#define ROOMCAST_SCORE_FLAGS_NO_NARRATION (1 << 1)

// More narration had arrived when this was published: newer scores follow.
#define ROOMCAST_SCORE_FLAGS_BEHIND (1 << 2)

// Narration was lost on the way (a gap in its sequence numbers).
#define ROOMCAST_SCORE_FLAGS_GAP (1 << 3)

// More sources said something new than there are places: included names the most recent ones, and the others wait for their
// confirmation.
#define ROOMCAST_SCORE_FLAGS_SOURCES_CUT (1 << 4)

// The last scoring attempt failed; these are the last good scores, sent again at once, with the narration and of the map that
// they are of. A later attempt scores what this one could not.
#define ROOMCAST_SCORE_FLAGS_SCORER_FAILED (1 << 5)

// All known persons and residents are away: no room is likely, and their scores are -inf.
#define ROOMCAST_SCORE_FLAGS_NOBODY_HOME (1 << 6)

// The model scored all of it before the narration came: timing_ns has no decoder in it.
#define ROOMCAST_SCORE_FLAGS_PREPARED (1 << 7)

// The model does not know the words of a person's narration or of the map's labels: the scores say little, and weigh less in the
// forecast.
#define ROOMCAST_SCORE_FLAGS_UNFAMILIAR (1 << 8)

// The model fails the check of its first scores: all scores are noise, and forecasts leave them out. The daemon's log has the reason.
#define ROOMCAST_SCORE_FLAGS_MODEL_WEAK (1 << 9)

// Most persons in one message; the longest silent ones are left out, and PersonScoresV1::persons says how many there are.
#define ROOMCAST_MAX_PERSONS 8

// Each observation of the person is from before the daemon's start.
#define ROOMCAST_PERSON_FLAGS_RESTORED 1

// Nothing for long, on a bed: possibly asleep.
#define ROOMCAST_PERSON_FLAGS_ASLEEP (1 << 1)

// The newest narration had no name, and fitted this person best.
#define ROOMCAST_PERSON_FLAGS_BY_FIT (1 << 2)

// Not of the household: forgotten after a silence.
#define ROOMCAST_PERSON_FLAGS_VISITOR (1 << 3)

// The model does not know the words of the person's narration or of the map's labels.
#define ROOMCAST_PERSON_FLAGS_UNFAMILIAR (1 << 4)

// The person was not observed yet.
#define ROOMCAST_PRESENCE_UNKNOWN 0

// In the house.
#define ROOMCAST_PRESENCE_PRESENT 1

// Out of the house, and expected back.
#define ROOMCAST_PRESENCE_AWAY 2

// Out of the house, and not expected back.
#define ROOMCAST_PRESENCE_GONE 3

// Value of ItemScoreV1::partition: the item lies in none.
#define ROOMCAST_NO_PARTITION UINT32_MAX

// Most items of a message: of a larger map the best. Shared memory is set aside for every message that may be under way, each as long as
// the longest.
#define ROOMCAST_MAX_ITEMS 1024

// Most points in time of a forecast.
#define ROOMCAST_MAX_HORIZONS 16

// No person was observed, or a resident was not observed and all others are away; and no sensor shows a person: all rooms are equally likely.
#define ROOMCAST_FORECAST_FLAGS_NOT_KNOWN 1

// The last event of a person is from before the daemon's start.
#define ROOMCAST_FORECAST_FLAGS_RESTORED (1 << 1)

// The house is empty now.
#define ROOMCAST_FORECAST_FLAGS_NOBODY_HOME (1 << 2)

// A resident was not observed and may be in any room. Without sensors, the probabilities lack this resident.
#define ROOMCAST_FORECAST_FLAGS_RESIDENT_UNKNOWN (1 << 3)

// The scores have the flag of this name: belief, stays and habits take the place of the model for the persons concerned.
#define ROOMCAST_FORECAST_FLAGS_UNFAMILIAR (1 << 4)

// The scores have the flag of this name: the forecast rests on belief, stays and habits alone.
#define ROOMCAST_FORECAST_FLAGS_MODEL_WEAK (1 << 5)

// Most bytes of a decision's reason.
#define ROOMCAST_REASON_TEXT_BYTES 256

// Nothing is to be done: the robot waits in to, which may be another room than its own, or where it is if to is empty.
#define ROOMCAST_ACTION_STAY 0

// The robot goes to to and works there.
#define ROOMCAST_ACTION_GO 1

// The robot stops its work and waits where it disturbs nobody, at its dock if it has one.
#define ROOMCAST_ACTION_PAUSE 2

// Not the policy's choice but the safe fallback.
#define ROOMCAST_DECISION_FLAGS_FALLBACK 1

// The scores were older than the planner's deadline.
#define ROOMCAST_DECISION_FLAGS_STALE (1 << 1)

// No scores were received at all.
#define ROOMCAST_DECISION_FLAGS_NO_SCORES (1 << 2)

// The daemon was silent for longer than its heartbeat allows.
#define ROOMCAST_DECISION_FLAGS_DAEMON_SILENT (1 << 3)

// Every room has been covered.
#define ROOMCAST_DECISION_FLAGS_COVERED (1 << 4)

// A person came into the room that the robot was in: what it did there is not done.
#define ROOMCAST_DECISION_FLAGS_INTERRUPTED (1 << 5)

// covered counts what the robot reported as finished; without this bit, the clock.
#define ROOMCAST_DECISION_FLAGS_REPORTED (1 << 6)

// The round's deadline leaves no later slot for this room.
#define ROOMCAST_DECISION_FLAGS_DEADLINE (1 << 7)

// Nothing is known of anybody: the room scores say nothing about persons.
#define ROOMCAST_DECISION_FLAGS_NOT_KNOWN (1 << 8)

// Everybody who is known is away.
#define ROOMCAST_DECISION_FLAGS_NOBODY_HOME (1 << 9)

// The robot has reported before and has been silent for longer than allowed.
#define ROOMCAST_DECISION_FLAGS_ROBOT_SILENT (1 << 10)

// The work was asked for before and its time is over: the robot owes a report of it, and is not to begin it again.
#define ROOMCAST_DECISION_FLAGS_OWED (1 << 11)

// Decided in another domain and repeated here, so that this domain's robots keep clear of that one. It is an order to none.
#define ROOMCAST_DECISION_FLAGS_ELSEWHERE (1 << 12)

// A person holds the robot: it does not work until held_until_unix_ns, or until a person resumes.
#define ROOMCAST_DECISION_FLAGS_HELD (1 << 13)

// Most bytes of a report's note.
#define ROOMCAST_NOTE_TEXT_BYTES 120

// Where the robot is.
#define ROOMCAST_REPORT_KIND_POSITION 0

// It is in the room and has begun to work there.
#define ROOMCAST_REPORT_KIND_STARTED 1

// The work in the room is done.
#define ROOMCAST_REPORT_KIND_FINISHED 2

// The work in the room failed; the robot is free again.
#define ROOMCAST_REPORT_KIND_FAILED 3

// It does not get into the room; the robot is free again.
#define ROOMCAST_REPORT_KIND_BLOCKED 4

// It is at its dock, and charges.
#define ROOMCAST_REPORT_KIND_DOCKED 5

// How full the battery is.
#define ROOMCAST_REPORT_KIND_BATTERY 6

// Somebody, or the robot itself, took the decision back; the robot is free again.
#define ROOMCAST_REPORT_KIND_CANCELLED 7

// A person's order, no report: the robot does not work until until_unix_ns, or until RESUME. note says why.
#define ROOMCAST_REPORT_KIND_HOLD 8

// A person's order: the hold ends.
#define ROOMCAST_REPORT_KIND_RESUME 9

// A person's order: clean room now.
#define ROOMCAST_REPORT_KIND_CLEAN 10

// A person's order: skip room today.
#define ROOMCAST_REPORT_KIND_SKIP 11

// position_m says where the robot is.
#define ROOMCAST_REPORT_FLAGS_HAS_POSITION 1

// battery says how full the battery is.
#define ROOMCAST_REPORT_FLAGS_HAS_BATTERY (1 << 1)

// One observation of a person, from a narrator: an action that is complete, a device state, or a sentence.
//
// (source, epoch, sequence) names it for good: what a narrator sends again under the same name is not taken twice.
typedef struct RoomcastNarrationV1 {
  // The narrator, the same over restarts; 0 is not allowed.
  // (Offset 0.)
  uint64_t source;
  // Random per start of the narrator.
  // (Offset 8.)
  uint64_t epoch;
  // 1, 2, 3, ... within the epoch.
  // (Offset 16.)
  uint64_t sequence;
  // When it was observed: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t observed_ns;
  // When it was observed: Unix nanoseconds, for people.
  // (Offset 32.)
  uint64_t observed_unix_ns;
  // Which person, where person_name is empty; each has a history of its own. ALL_PERSONS is an unknown
  // person: the daemon weighs the event for all persons.
  // (Offset 40.)
  uint32_t person;
  // One of narration_kind.
  // (Offset 44.)
  uint32_t kind;
  // Bytes of text that follow in text, 1 to 1 024.
  // (Offset 48.)
  uint32_t text_bytes;
  // Minor version of the layout: 1, which has person_name, narration_kind::PRESENCE and somebody; count is 0 in older ones.
  // (Offset 52.)
  uint32_t minor;
  // The narrator's name, for people.
  // (Offset 56.)
  uint8_t source_name[ROOMCAST_NAME_BYTES];
  // The person's name, UTF-8, zero padded; empty where person says who it is.
  // (Offset 104.)
  uint8_t person_name[ROOMCAST_NAME_BYTES];
  // The number of persons that the narrator counted, at most 8; 0 if it counted none.
  // (Offset 152.)
  uint32_t count;
  // Zero.
  // (Offset 156.)
  uint8_t reserved[36];
  // The text, UTF-8, the rest zero.
  // (Offset 192.)
  uint8_t text[ROOMCAST_NARRATION_TEXT_BYTES];
} RoomcastNarrationV1;

// The newest narration of one start of a source that a message's scores contain, or that was dealt with otherwise. Several
// processes may use one source at once, each with an epoch of its own.
typedef struct RoomcastIncludedV1 {
  // The narrator.
  // (Offset 0.)
  uint64_t source;
  // Its epoch.
  // (Offset 8.)
  uint64_t epoch;
  // Highest sequence number dealt with; all accepted ones up to it went through the history.
  // (Offset 16.)
  uint64_t sequence;
  // When that was observed: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t observed_ns;
  // Narrations of this source in this epoch that the daemon has accepted, those of its journal included.
  // (Offset 32.)
  uint64_t accepted;
} RoomcastIncludedV1;

// How likely somebody is in one room soon.
typedef struct RoomcastRoomV1 {
  // The partition's id in the map, UTF-8, zero padded.
  // (Offset 0.)
  uint8_t id[ROOMCAST_NAME_BYTES];
  // Of one person, Equation 2's sum over the room's items, in nats; -inf when it has none. Of several, the logarithm of
  // probability.
  // (Offset 48.)
  double log_score_nats;
  // The true value lies at or above this, in nats.
  // (Offset 56.)
  double lower_log_score_nats;
  // The true value lies at or below this, in nats.
  // (Offset 64.)
  double upper_log_score_nats;
  // Of one person, the score's share of all rooms' scores, 0 to 1: that they are there next; they sum to one. Of several, that
  // somebody is there next; they sum to their number at most.
  // (Offset 72.)
  double probability;
} RoomcastRoomV1;

// A full snapshot of what the daemon knows: a late joiner needs nothing else.
//
// The same (epoch, sequence) may come again as a heartbeat, every 250 ms, with a newer published_ns.
typedef struct RoomcastRoomScoresV1 {
  // Random per start of the daemon.
  // (Offset 0.)
  uint64_t epoch;
  // 1, 2, 3, ... within the epoch; a jump means that snapshots were overwritten before they were read.
  // (Offset 8.)
  uint64_t sequence;
  // When the scores were computed: monotonic nanoseconds. Their age counts from here.
  // (Offset 16.)
  uint64_t computed_ns;
  // The same in Unix nanoseconds, for people.
  // (Offset 24.)
  uint64_t computed_unix_ns;
  // When this very message was sent: monotonic nanoseconds. The daemon's age counts from here.
  // (Offset 32.)
  uint64_t published_ns;
  // When the newest contained narration was observed: monotonic nanoseconds, 0 for none.
  // (Offset 40.)
  uint64_t observed_ns;
  // The receipt of the first narration that is new in these scores; without a new one, the last such
  // time. Monotonic nanoseconds, 0 for none.
  // (Offset 48.)
  uint64_t received_ns;
  // SHA-256 of the model file.
  // (Offset 56.)
  uint8_t model_fingerprint[32];
  // SHA-256 of the map.
  // (Offset 88.)
  uint8_t map_fingerprint[32];
  // Total probability of all labels as continuations, 0 to about 1; of several persons, the mean.
  // (Offset 120.)
  double label_mass;
  // Narrations in the window that the scores were computed from.
  // (Offset 128.)
  uint64_t window;
  // Time from received_ns to the start of the step, in nanoseconds; 0 where the scores contain nothing new.
  // (Offset 136.)
  uint64_t wait_ns;
  // Step's time: tokenising.
  // (Offset 144.)
  uint64_t tokenise_ns;
  // Step's time: decoding new narration and binding sequence.
  // (Offset 152.)
  uint64_t prefix_ns;
  // Step's time: decoding the labels' trie.
  // (Offset 160.)
  uint64_t trie_ns;
  // Step's time: grounding.
  // (Offset 168.)
  uint64_t ground_ns;
  // The person of these scores, or ALL_PERSONS.
  // (Offset 176.)
  uint32_t person;
  // Persons known.
  // (Offset 180.)
  uint32_t persons;
  // Rooms in rooms, at most 64.
  // (Offset 184.)
  uint32_t room_count;
  // Entries in included, at most 16.
  // (Offset 188.)
  uint32_t source_count;
  // One of reached.
  // (Offset 192.)
  uint32_t reached;
  // Bits of score_flags.
  // (Offset 196.)
  uint32_t flags;
  // Minor version of the layout: 0.
  // (Offset 200.)
  uint32_t minor;
  // Zero.
  // (Offset 204.)
  uint8_t reserved[52];
  // Per source, the newest narration contained; unused entries zero.
  // (Offset 256.)
  struct RoomcastIncludedV1 included[ROOMCAST_MAX_SOURCES];
  // The rooms in the map's order; unused entries zero.
  // (Offset 896.)
  struct RoomcastRoomV1 room[ROOMCAST_MAX_ROOMS];
} RoomcastRoomScoresV1;

// One person's scores, as if this person were alone.
typedef struct RoomcastPersonV1 {
  // The person's number, as narrators give it.
  // (Offset 0.)
  uint32_t person;
  // How their scores were reached, as in room scores.
  // (Offset 4.)
  uint32_t reached;
  // When they were observed last: monotonic nanoseconds, 0 where that was before the machine's start.
  // (Offset 8.)
  uint64_t observed_ns;
  // Narrations in their window.
  // (Offset 16.)
  uint64_t window;
  // Total probability of all labels as continuations, 0 to about 1.
  // (Offset 24.)
  double label_mass;
  // Bits of person_flags.
  // (Offset 32.)
  uint32_t flags;
  // One of presence.
  // (Offset 36.)
  uint32_t presence;
  // That the person is elsewhere next, outside the map's rooms, 0 to 1: 1 while away or gone.
  // (Offset 40.)
  double elsewhere;
  // Since when presence holds: monotonic nanoseconds, 0 where that was before the machine's start.
  // (Offset 48.)
  uint64_t since_ns;
  // The person's name, UTF-8, zero padded; empty for a person with a number only.
  // (Offset 56.)
  uint8_t name[ROOMCAST_NAME_BYTES];
  // Zero.
  // (Offset 104.)
  uint8_t reserved[24];
  // Per room Equation 2's sum over its items, in nats; -inf when it has none.
  // (Offset 128.)
  double log_score_nats[ROOMCAST_MAX_ROOMS];
  // Per room, the true value lies at or above this, in nats.
  // (Offset 640.)
  double lower_log_score_nats[ROOMCAST_MAX_ROOMS];
  // Per room, the true value lies at or below this, in nats.
  // (Offset 1152.)
  double upper_log_score_nats[ROOMCAST_MAX_ROOMS];
  // Per room the score's share of all rooms' scores, 0 to 1: that the person is there next. With elsewhere they sum to one.
  // (Offset 1664.)
  double probability[ROOMCAST_MAX_ROOMS];
} RoomcastPersonV1;

// The scores of each person, which the room scores of the same epoch and sequence speak of together.
typedef struct RoomcastPersonScoresV1 {
  // Epoch of the room scores that it goes with.
  // (Offset 0.)
  uint64_t epoch;
  // Sequence of those room scores.
  // (Offset 8.)
  uint64_t sequence;
  // When they were computed: monotonic nanoseconds.
  // (Offset 16.)
  uint64_t computed_ns;
  // When this message was sent: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t published_ns;
  // SHA-256 of the map.
  // (Offset 32.)
  uint8_t map_fingerprint[32];
  // Persons with a history; person names at most 8 of them.
  // (Offset 64.)
  uint32_t persons;
  // Entries in person, at most 8.
  // (Offset 68.)
  uint32_t person_count;
  // Rooms, at most 64.
  // (Offset 72.)
  uint32_t room_count;
  // Minor version of the layout: 0.
  // (Offset 76.)
  uint32_t minor;
  // Zero.
  // (Offset 80.)
  uint8_t reserved[48];
  // The rooms' ids in the map's order, UTF-8, zero padded.
  // (Offset 128.)
  uint8_t id[ROOMCAST_MAX_ROOMS][ROOMCAST_NAME_BYTES];
  // The persons, in the order of their numbers; unused entries zero.
  // (Offset 3200.)
  struct RoomcastPersonV1 person[ROOMCAST_MAX_PERSONS];
} RoomcastPersonScoresV1;

// User header of a slice of item scores: which snapshot they belong to.
typedef struct RoomcastItemScoresHeaderV1 {
  // Epoch of the room scores that these items add up to.
  // (Offset 0.)
  uint64_t epoch;
  // Sequence of those room scores.
  // (Offset 8.)
  uint64_t sequence;
  // When they were computed: monotonic nanoseconds.
  // (Offset 16.)
  uint64_t computed_ns;
  // Minor version of the layout: 1, which has items.
  // (Offset 24.)
  uint32_t minor;
  // Items of the map. If the map has more items than the message, the message has the MAX_ITEMS with the best scores.
  // (Offset 28.)
  uint32_t items;
  // Zero.
  // (Offset 32.)
  uint8_t reserved[32];
} RoomcastItemScoresHeaderV1;

// The score of one item of the map. Sent only while somebody subscribes.
typedef struct RoomcastItemScoreV1 {
  // The item's id in the map, UTF-8, zero padded, cut to fit.
  // (Offset 0.)
  uint8_t id[ROOMCAST_NAME_BYTES];
  // Its label, UTF-8, zero padded, cut to fit.
  // (Offset 48.)
  uint8_t label[ROOMCAST_NAME_BYTES];
  // s_i = s_c / n_l, in nats; of several persons, the mean of their shares of their label mass, times the mean label mass.
  // (Offset 96.)
  double log_score_nats;
  // Index of its room in RoomScoresV1::rooms, or NO_PARTITION.
  // (Offset 104.)
  uint32_t partition;
  // Items of the map with this label. Captions and rooms of that name count in n_l too, and not here.
  // (Offset 108.)
  uint32_t label_items;
} RoomcastItemScoreV1;

// P(room is occupied at computed_ns + horizon), for a grid of horizons.
typedef struct RoomcastForecastV1 {
  // Epoch of the room scores that it follows from.
  // (Offset 0.)
  uint64_t epoch;
  // Sequence of those room scores.
  // (Offset 8.)
  uint64_t sequence;
  // When it was computed: monotonic nanoseconds.
  // (Offset 16.)
  uint64_t computed_ns;
  // When this message was sent: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t published_ns;
  // Rooms, at most 64.
  // (Offset 32.)
  uint32_t room_count;
  // Horizons, at most 16.
  // (Offset 36.)
  uint32_t horizon_count;
  // Person, or ALL_PERSONS.
  // (Offset 40.)
  uint32_t person;
  // Minor version of the layout: 1 has flags, 2 has elsewhere; they are 0 before.
  // (Offset 44.)
  uint32_t minor;
  // Bits of forecast_flags.
  // (Offset 48.)
  uint32_t flags;
  // Probability per horizon that all persons are elsewhere, outside the map's rooms, 0 to 1.
  // (Offset 52.)
  float elsewhere[ROOMCAST_MAX_HORIZONS];
  // Zero.
  // (Offset 116.)
  uint8_t reserved[12];
  // The horizons in seconds, rising.
  // (Offset 128.)
  float horizon_s[ROOMCAST_MAX_HORIZONS];
  // The rooms' ids, UTF-8, zero padded.
  // (Offset 192.)
  uint8_t id[ROOMCAST_MAX_ROOMS][ROOMCAST_NAME_BYTES];
  // probability[room][horizon], 0 to 1: that a person is there. A horizon's column and elsewhere sum to one for one person,
  // and the column to at most their number for several. The sum of a room's row has no meaning.
  // (Offset 3264.)
  float probability[ROOMCAST_MAX_ROOMS][ROOMCAST_MAX_HORIZONS];
} RoomcastForecastV1;

// Where one person will be: P(room at computed_ns + horizon), and P(elsewhere), which together sum to one per horizon.
typedef struct RoomcastPersonForecastV1 {
  // The person's number.
  // (Offset 0.)
  uint32_t person;
  // One of presence.
  // (Offset 4.)
  uint32_t presence;
  // Bits of person_flags.
  // (Offset 8.)
  uint32_t flags;
  // Zero.
  // (Offset 12.)
  uint8_t reserved_a[4];
  // The person's name, UTF-8, zero padded; empty for a person with a number only.
  // (Offset 16.)
  uint8_t name[ROOMCAST_NAME_BYTES];
  // Per horizon that the person is elsewhere, outside the map's rooms, 0 to 1.
  // (Offset 64.)
  float elsewhere[ROOMCAST_MAX_HORIZONS];
  // Per horizon the smallest set of rooms that holds the person with the coverage below; bit i is room i.
  // (Offset 128.)
  uint64_t room_set[ROOMCAST_MAX_HORIZONS];
  // The coverage that the sets are for, 0 to 1; 0 where there are no sets.
  // (Offset 256.)
  float set_coverage;
  // Bit h: elsewhere belongs to the set of horizon h.
  // (Offset 260.)
  uint32_t set_elsewhere;
  // Observations behind the person's habits, 0 without habits.
  // (Offset 264.)
  float observations;
  // Share of the habits in the forecast, LEARNED_SHARE_S seconds ahead, 0 to 1.
  // (Offset 268.)
  float learned_share[3];
  // Zero.
  // (Offset 280.)
  uint8_t reserved[40];
  // probability[room][horizon], 0 to 1.
  // (Offset 320.)
  float probability[ROOMCAST_MAX_ROOMS][ROOMCAST_MAX_HORIZONS];
} RoomcastPersonForecastV1;

// Where each person will be.
typedef struct RoomcastPersonForecastsV1 {
  // Epoch of the room scores that it follows from.
  // (Offset 0.)
  uint64_t epoch;
  // Sequence of those room scores.
  // (Offset 8.)
  uint64_t sequence;
  // When it was computed: monotonic nanoseconds.
  // (Offset 16.)
  uint64_t computed_ns;
  // When this message was sent: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t published_ns;
  // Rooms, at most 64.
  // (Offset 32.)
  uint32_t room_count;
  // Horizons, at most 16.
  // (Offset 36.)
  uint32_t horizon_count;
  // Persons known; person names at most 8 of them.
  // (Offset 40.)
  uint32_t persons;
  // Entries in person, at most 8.
  // (Offset 44.)
  uint32_t person_count;
  // Minor version of the layout: 1 has sets, observations and learned_share; they are 0 before.
  // (Offset 48.)
  uint32_t minor;
  // Zero.
  // (Offset 52.)
  uint8_t reserved[76];
  // The horizons in seconds, rising.
  // (Offset 128.)
  float horizon_s[ROOMCAST_MAX_HORIZONS];
  // The rooms' ids in the map's order, UTF-8, zero padded.
  // (Offset 192.)
  uint8_t id[ROOMCAST_MAX_ROOMS][ROOMCAST_NAME_BYTES];
  // The persons, in the order of their numbers; unused entries zero.
  // (Offset 3264.)
  struct RoomcastPersonForecastV1 person[ROOMCAST_MAX_PERSONS];
} RoomcastPersonForecastsV1;

// Where a robot goes next, and why.
typedef struct RoomcastDecisionV1 {
  // The robot.
  // (Offset 0.)
  uint64_t robot;
  // Random per start of the planner.
  // (Offset 8.)
  uint64_t epoch;
  // 1, 2, 3, ... within the epoch.
  // (Offset 16.)
  uint64_t sequence;
  // When it was decided: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t decided_ns;
  // The same in Unix nanoseconds, for people.
  // (Offset 32.)
  uint64_t decided_unix_ns;
  // Epoch of the scores it rests on; 0 for none.
  // (Offset 40.)
  uint64_t scores_epoch;
  // Sequence of those scores.
  // (Offset 48.)
  uint64_t scores_sequence;
  // Age of those scores at the decision, in nanoseconds.
  // (Offset 56.)
  uint64_t scores_age_ns;
  // When the newest narration in those scores was observed: monotonic nanoseconds.
  // (Offset 64.)
  uint64_t observed_ns;
  // Bit i: room i has been covered.
  // (Offset 72.)
  uint64_t covered;
  // How likely somebody is in the room gone to, 0 to 1: by the forecast over the stay, where the policy plans by it; else the
  // room's score.
  // (Offset 80.)
  double probability;
  // How long the robot will stay there, in nanoseconds; 0 where no stay is planned.
  // (Offset 88.)
  uint64_t stay_ns;
  // One of action.
  // (Offset 96.)
  uint32_t action;
  // Bits of decision_flags.
  // (Offset 100.)
  uint32_t flags;
  // Minor version of the layout: 4, which has held_until_unix_ns and cleaned_min; 3 has decision_flags::ELSEWHERE; 2 has robot_name and decision_flags::OWED; 1 has
  // action::PAUSE and cancels.
  // (Offset 104.)
  uint32_t minor;
  // Zero.
  // (Offset 108.)
  uint8_t reserved_a[4];
  // The room it is in, UTF-8, zero padded; empty when unknown.
  // (Offset 112.)
  uint8_t from[ROOMCAST_NAME_BYTES];
  // The room it goes to (or stays in).
  // (Offset 160.)
  uint8_t to[ROOMCAST_NAME_BYTES];
  // The policy's name.
  // (Offset 208.)
  uint8_t policy[ROOMCAST_NAME_BYTES];
  // Why, in words, UTF-8, zero padded, cut to fit.
  // (Offset 256.)
  uint8_t reason[ROOMCAST_REASON_TEXT_BYTES];
  // Sequence of the decision of this epoch that does not hold any more, 0 for none.
  // (Offset 512.)
  uint64_t cancels;
  // The robot's name, UTF-8, zero padded; empty where whoever decides does not tell it.
  // (Offset 520.)
  uint8_t robot_name[ROOMCAST_NAME_BYTES];
  // The end of a hold in Unix nanoseconds; 0 where there is no hold, or no end.
  // (Offset 568.)
  uint64_t held_until_unix_ns;
  // Per room the whole minutes from its last cleaning to this decision, plus 1; 0 where none is known. 65535 stands for all longer times.
  // (Offset 576.)
  uint16_t cleaned_min[ROOMCAST_MAX_ROOMS];
  // Zero.
  // (Offset 704.)
  uint8_t reserved[64];
} RoomcastDecisionV1;

// What a robot says of itself: where it is, and what became of a decision.
typedef struct RoomcastRobotReportV1 {
  // The robot, by the number that decisions name it with.
  // (Offset 0.)
  uint64_t robot;
  // Random per start of the reporter.
  // (Offset 8.)
  uint64_t epoch;
  // 1, 2, 3, ... within the epoch.
  // (Offset 16.)
  uint64_t sequence;
  // When it was so: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t reported_ns;
  // The same in Unix nanoseconds, for people.
  // (Offset 32.)
  uint64_t reported_unix_ns;
  // Epoch of the decision that it answers, 0 for none.
  // (Offset 40.)
  uint64_t decision_epoch;
  // Sequence of that decision, 0 for none.
  // (Offset 48.)
  uint64_t decision_sequence;
  // Where the robot is, in the map's metres; it counts with report_flags::HAS_POSITION.
  // (Offset 56.)
  double position_m[3];
  // How full the battery is, 0 to 1; it counts with report_flags::HAS_BATTERY.
  // (Offset 80.)
  double battery;
  // One of report_kind.
  // (Offset 88.)
  uint32_t kind;
  // Bits of report_flags.
  // (Offset 92.)
  uint32_t flags;
  // Minor version of the layout: 1, which has orders of persons and until_unix_ns.
  // (Offset 96.)
  uint32_t minor;
  // Zero.
  // (Offset 100.)
  uint8_t reserved_a[4];
  // The robot's name, UTF-8, zero padded.
  // (Offset 104.)
  uint8_t robot_name[ROOMCAST_NAME_BYTES];
  // The room that it speaks of, UTF-8, zero padded; empty where the position or the decision tells.
  // (Offset 152.)
  uint8_t room[ROOMCAST_NAME_BYTES];
  // Why, in words, UTF-8, zero padded.
  // (Offset 200.)
  uint8_t note[ROOMCAST_NOTE_TEXT_BYTES];
  // The end of a hold in Unix nanoseconds; 0 for none.
  // (Offset 320.)
  uint64_t until_unix_ns;
  // Zero.
  // (Offset 328.)
  uint8_t reserved[184];
} RoomcastRobotReportV1;

// Asks the daemon how it is.
typedef struct RoomcastStatusRequestV1 {
  // Minor version of the layout that the asker knows: 0.
  // (Offset 0.)
  uint32_t minor;
  // Zero.
  // (Offset 4.)
  uint8_t reserved[12];
} RoomcastStatusRequestV1;

// The daemon's health, versions and counters. Counters count since the daemon's start.
typedef struct RoomcastStatusResponseV1 {
  // The daemon's epoch, as in its scores.
  // (Offset 0.)
  uint64_t epoch;
  // Sequence of its newest scores.
  // (Offset 8.)
  uint64_t sequence;
  // When it started: Unix nanoseconds.
  // (Offset 16.)
  uint64_t started_unix_ns;
  // When it answered: monotonic nanoseconds.
  // (Offset 24.)
  uint64_t answered_ns;
  // Narrations received, in any condition.
  // (Offset 32.)
  uint64_t received;
  // Narrations that went into a history.
  // (Offset 40.)
  uint64_t accepted;
  // Narrations received a second time, and ignored.
  // (Offset 48.)
  uint64_t duplicates;
  // Narrations that never arrived (gaps in sequence numbers).
  // (Offset 56.)
  uint64_t missed;
  // Malformed messages, counted and dropped.
  // (Offset 64.)
  uint64_t malformed;
  // Narrations refused by a source's rate limit or quota.
  // (Offset 72.)
  uint64_t limited;
  // Scoring steps.
  // (Offset 80.)
  uint64_t steps;
  // Narrations scored together with a newer one.
  // (Offset 88.)
  uint64_t merged;
  // Steps that failed in the scorer.
  // (Offset 96.)
  uint64_t failed_steps;
  // Snapshots sent, heartbeats not counted.
  // (Offset 104.)
  uint64_t published;
  // Heartbeats sent.
  // (Offset 112.)
  uint64_t heartbeats;
  // Narrations restored from the journal at the start.
  // (Offset 120.)
  uint64_t restored;
  // Narrations that wait for the next step.
  // (Offset 128.)
  uint64_t waiting;
  // Median time from the receipt of an event to its scores, over the run, in nanoseconds.
  // (Offset 136.)
  uint64_t latency_p50_ns;
  // Event to scores, 99th percentile, in nanoseconds.
  // (Offset 144.)
  uint64_t latency_p99_ns;
  // Event to scores, worst, in nanoseconds.
  // (Offset 152.)
  uint64_t latency_max_ns;
  // SHA-256 of the model file.
  // (Offset 160.)
  uint8_t model_fingerprint[32];
  // SHA-256 of the map.
  // (Offset 192.)
  uint8_t map_fingerprint[32];
  // The daemon's process id.
  // (Offset 224.)
  uint32_t process;
  // Narrators known.
  // (Offset 228.)
  uint32_t sources;
  // Persons known.
  // (Offset 232.)
  uint32_t persons;
  // Minor version of the layout: 1 has forged, costly and learned, 2 what
  // follows learned, 3 ahead; they are 0 before.
  // (Offset 236.)
  uint32_t minor;
  // Version of the daemon, UTF-8, zero padded.
  // (Offset 240.)
  uint8_t version[ROOMCAST_NAME_BYTES];
  // The map's name.
  // (Offset 288.)
  uint8_t map[ROOMCAST_NAME_BYTES];
  // The model's name.
  // (Offset 336.)
  uint8_t model[ROOMCAST_NAME_BYTES];
  // Journal: bytes on disk, of both its files.
  // (Offset 384.)
  uint64_t journal_bytes;
  // Journal: failed writes, and at the start the number of damaged databases.
  // (Offset 392.)
  uint64_t journal_failures;
  // Narrations in the name of a source that another port uses.
  // (Offset 400.)
  uint64_t forged;
  // Narrations refused because their tokens do not fit the window.
  // (Offset 408.)
  uint64_t costly;
  // Observations that the habits rest on.
  // (Offset 416.)
  uint64_t learned;
  // Bytes of memory that the habits take.
  // (Offset 424.)
  uint64_t habits_bytes;
  // Counts that the habits hold.
  // (Offset 432.)
  uint64_t habits_counts;
  // Names of things that the habits hold.
  // (Offset 440.)
  uint32_t habits_names;
  // Persons with learned habits.
  // (Offset 444.)
  uint32_t habits_persons;
  // Prompts that steps asked the model about.
  // (Offset 448.)
  uint64_t asked;
  // Answers prepared in idle time.
  // (Offset 456.)
  uint64_t prepared;
  // Prepared answers that a step used.
  // (Offset 464.)
  uint64_t prepared_used;
  // Nanoseconds of the processor spent preparing.
  // (Offset 472.)
  uint64_t prepare_ns;
  // Narrations that a fast clock dated more than a second ahead. They count as observed when they came.
  // (Offset 480.)
  uint64_t ahead;
  // How far the newest of them lay ahead, in nanoseconds.
  // (Offset 488.)
  uint64_t ahead_ns;
  // Zero.
  // (Offset 496.)
  uint8_t reserved[16];
} RoomcastStatusResponseV1;

// How far ahead the entries of PersonForecastV1::learned_share look, in seconds.
#define ROOMCAST_LEARNED_SHARE_S { 60.0, 900.0, 3600.0, }

#endif  /* ROOMCAST_H */


/* Type names, as iceoryx2 compares them. */
#define ROOMCAST_TYPE_NAME_NARRATIONV1 "roomcast.NarrationV1"
#define ROOMCAST_TYPE_NAME_ROOMSCORESV1 "roomcast.RoomScoresV1"
#define ROOMCAST_TYPE_NAME_PERSONSCORESV1 "roomcast.PersonScoresV1"
#define ROOMCAST_TYPE_NAME_ITEMSCOREV1 "roomcast.ItemScoreV1"
#define ROOMCAST_TYPE_NAME_ITEMSCORESHEADERV1 "roomcast.ItemScoresHeaderV1"
#define ROOMCAST_TYPE_NAME_FORECASTV1 "roomcast.ForecastV1"
#define ROOMCAST_TYPE_NAME_PERSONFORECASTSV1 "roomcast.PersonForecastsV1"
#define ROOMCAST_TYPE_NAME_DECISIONV1 "roomcast.DecisionV1"
#define ROOMCAST_TYPE_NAME_ROBOTREPORTV1 "roomcast.RobotReportV1"
#define ROOMCAST_TYPE_NAME_STATUSREQUESTV1 "roomcast.StatusRequestV1"
#define ROOMCAST_TYPE_NAME_STATUSRESPONSEV1 "roomcast.StatusResponseV1"

/* Publish-subscribe services and their quality; every participant states all of it. Safe overflow is on. */
#define ROOMCAST_SERVICE_NARRATION "roomcast/v1/narration"
#define ROOMCAST_NARRATION_MAX_PUBLISHERS 8
#define ROOMCAST_NARRATION_MAX_SUBSCRIBERS 4
#define ROOMCAST_NARRATION_BUFFER_SIZE 256
#define ROOMCAST_NARRATION_HISTORY_SIZE 32
#define ROOMCAST_SERVICE_ROOM_SCORES "roomcast/v1/room-scores"
#define ROOMCAST_ROOM_SCORES_MAX_PUBLISHERS 1
#define ROOMCAST_ROOM_SCORES_MAX_SUBSCRIBERS 16
#define ROOMCAST_ROOM_SCORES_BUFFER_SIZE 2
#define ROOMCAST_ROOM_SCORES_HISTORY_SIZE 1
#define ROOMCAST_SERVICE_PERSON_SCORES "roomcast/v1/person-scores"
#define ROOMCAST_PERSON_SCORES_MAX_PUBLISHERS 1
#define ROOMCAST_PERSON_SCORES_MAX_SUBSCRIBERS 16
#define ROOMCAST_PERSON_SCORES_BUFFER_SIZE 2
#define ROOMCAST_PERSON_SCORES_HISTORY_SIZE 1
#define ROOMCAST_SERVICE_FORECAST "roomcast/v1/forecast"
#define ROOMCAST_FORECAST_MAX_PUBLISHERS 1
#define ROOMCAST_FORECAST_MAX_SUBSCRIBERS 16
#define ROOMCAST_FORECAST_BUFFER_SIZE 2
#define ROOMCAST_FORECAST_HISTORY_SIZE 1
#define ROOMCAST_SERVICE_PERSON_FORECASTS "roomcast/v1/person-forecasts"
#define ROOMCAST_PERSON_FORECASTS_MAX_PUBLISHERS 1
#define ROOMCAST_PERSON_FORECASTS_MAX_SUBSCRIBERS 16
#define ROOMCAST_PERSON_FORECASTS_BUFFER_SIZE 2
#define ROOMCAST_PERSON_FORECASTS_HISTORY_SIZE 1
#define ROOMCAST_SERVICE_DECISION "roomcast/v1/decision"
#define ROOMCAST_DECISION_MAX_PUBLISHERS 8
#define ROOMCAST_DECISION_MAX_SUBSCRIBERS 16
#define ROOMCAST_DECISION_BUFFER_SIZE 16
#define ROOMCAST_DECISION_HISTORY_SIZE 1
#define ROOMCAST_SERVICE_ROBOT_REPORT "roomcast/v1/robot-report"
#define ROOMCAST_ROBOT_REPORT_MAX_PUBLISHERS 8
#define ROOMCAST_ROBOT_REPORT_MAX_SUBSCRIBERS 8
#define ROOMCAST_ROBOT_REPORT_BUFFER_SIZE 64
#define ROOMCAST_ROBOT_REPORT_HISTORY_SIZE 8

#if defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#include <stddef.h>
_Static_assert(sizeof(RoomcastNarrationV1) == 1216, "RoomcastNarrationV1");
_Static_assert(offsetof(RoomcastNarrationV1, source) == 0, "RoomcastNarrationV1.source");
_Static_assert(offsetof(RoomcastNarrationV1, epoch) == 8, "RoomcastNarrationV1.epoch");
_Static_assert(offsetof(RoomcastNarrationV1, sequence) == 16, "RoomcastNarrationV1.sequence");
_Static_assert(offsetof(RoomcastNarrationV1, observed_ns) == 24, "RoomcastNarrationV1.observed_ns");
_Static_assert(offsetof(RoomcastNarrationV1, observed_unix_ns) == 32, "RoomcastNarrationV1.observed_unix_ns");
_Static_assert(offsetof(RoomcastNarrationV1, person) == 40, "RoomcastNarrationV1.person");
_Static_assert(offsetof(RoomcastNarrationV1, kind) == 44, "RoomcastNarrationV1.kind");
_Static_assert(offsetof(RoomcastNarrationV1, text_bytes) == 48, "RoomcastNarrationV1.text_bytes");
_Static_assert(offsetof(RoomcastNarrationV1, minor) == 52, "RoomcastNarrationV1.minor");
_Static_assert(offsetof(RoomcastNarrationV1, source_name) == 56, "RoomcastNarrationV1.source_name");
_Static_assert(offsetof(RoomcastNarrationV1, person_name) == 104, "RoomcastNarrationV1.person_name");
_Static_assert(offsetof(RoomcastNarrationV1, count) == 152, "RoomcastNarrationV1.count");
_Static_assert(offsetof(RoomcastNarrationV1, reserved) == 156, "RoomcastNarrationV1.reserved");
_Static_assert(offsetof(RoomcastNarrationV1, text) == 192, "RoomcastNarrationV1.text");
_Static_assert(sizeof(RoomcastIncludedV1) == 40, "RoomcastIncludedV1");
_Static_assert(offsetof(RoomcastIncludedV1, source) == 0, "RoomcastIncludedV1.source");
_Static_assert(offsetof(RoomcastIncludedV1, epoch) == 8, "RoomcastIncludedV1.epoch");
_Static_assert(offsetof(RoomcastIncludedV1, sequence) == 16, "RoomcastIncludedV1.sequence");
_Static_assert(offsetof(RoomcastIncludedV1, observed_ns) == 24, "RoomcastIncludedV1.observed_ns");
_Static_assert(offsetof(RoomcastIncludedV1, accepted) == 32, "RoomcastIncludedV1.accepted");
_Static_assert(sizeof(RoomcastRoomV1) == 80, "RoomcastRoomV1");
_Static_assert(offsetof(RoomcastRoomV1, id) == 0, "RoomcastRoomV1.id");
_Static_assert(offsetof(RoomcastRoomV1, log_score_nats) == 48, "RoomcastRoomV1.log_score_nats");
_Static_assert(offsetof(RoomcastRoomV1, lower_log_score_nats) == 56, "RoomcastRoomV1.lower_log_score_nats");
_Static_assert(offsetof(RoomcastRoomV1, upper_log_score_nats) == 64, "RoomcastRoomV1.upper_log_score_nats");
_Static_assert(offsetof(RoomcastRoomV1, probability) == 72, "RoomcastRoomV1.probability");
_Static_assert(sizeof(RoomcastRoomScoresV1) == 6016, "RoomcastRoomScoresV1");
_Static_assert(offsetof(RoomcastRoomScoresV1, epoch) == 0, "RoomcastRoomScoresV1.epoch");
_Static_assert(offsetof(RoomcastRoomScoresV1, sequence) == 8, "RoomcastRoomScoresV1.sequence");
_Static_assert(offsetof(RoomcastRoomScoresV1, computed_ns) == 16, "RoomcastRoomScoresV1.computed_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, computed_unix_ns) == 24, "RoomcastRoomScoresV1.computed_unix_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, published_ns) == 32, "RoomcastRoomScoresV1.published_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, observed_ns) == 40, "RoomcastRoomScoresV1.observed_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, received_ns) == 48, "RoomcastRoomScoresV1.received_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, model_fingerprint) == 56, "RoomcastRoomScoresV1.model_fingerprint");
_Static_assert(offsetof(RoomcastRoomScoresV1, map_fingerprint) == 88, "RoomcastRoomScoresV1.map_fingerprint");
_Static_assert(offsetof(RoomcastRoomScoresV1, label_mass) == 120, "RoomcastRoomScoresV1.label_mass");
_Static_assert(offsetof(RoomcastRoomScoresV1, window) == 128, "RoomcastRoomScoresV1.window");
_Static_assert(offsetof(RoomcastRoomScoresV1, wait_ns) == 136, "RoomcastRoomScoresV1.wait_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, tokenise_ns) == 144, "RoomcastRoomScoresV1.tokenise_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, prefix_ns) == 152, "RoomcastRoomScoresV1.prefix_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, trie_ns) == 160, "RoomcastRoomScoresV1.trie_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, ground_ns) == 168, "RoomcastRoomScoresV1.ground_ns");
_Static_assert(offsetof(RoomcastRoomScoresV1, person) == 176, "RoomcastRoomScoresV1.person");
_Static_assert(offsetof(RoomcastRoomScoresV1, persons) == 180, "RoomcastRoomScoresV1.persons");
_Static_assert(offsetof(RoomcastRoomScoresV1, room_count) == 184, "RoomcastRoomScoresV1.room_count");
_Static_assert(offsetof(RoomcastRoomScoresV1, source_count) == 188, "RoomcastRoomScoresV1.source_count");
_Static_assert(offsetof(RoomcastRoomScoresV1, reached) == 192, "RoomcastRoomScoresV1.reached");
_Static_assert(offsetof(RoomcastRoomScoresV1, flags) == 196, "RoomcastRoomScoresV1.flags");
_Static_assert(offsetof(RoomcastRoomScoresV1, minor) == 200, "RoomcastRoomScoresV1.minor");
_Static_assert(offsetof(RoomcastRoomScoresV1, reserved) == 204, "RoomcastRoomScoresV1.reserved");
_Static_assert(offsetof(RoomcastRoomScoresV1, included) == 256, "RoomcastRoomScoresV1.included");
_Static_assert(offsetof(RoomcastRoomScoresV1, room) == 896, "RoomcastRoomScoresV1.room");
_Static_assert(sizeof(RoomcastPersonV1) == 2176, "RoomcastPersonV1");
_Static_assert(offsetof(RoomcastPersonV1, person) == 0, "RoomcastPersonV1.person");
_Static_assert(offsetof(RoomcastPersonV1, reached) == 4, "RoomcastPersonV1.reached");
_Static_assert(offsetof(RoomcastPersonV1, observed_ns) == 8, "RoomcastPersonV1.observed_ns");
_Static_assert(offsetof(RoomcastPersonV1, window) == 16, "RoomcastPersonV1.window");
_Static_assert(offsetof(RoomcastPersonV1, label_mass) == 24, "RoomcastPersonV1.label_mass");
_Static_assert(offsetof(RoomcastPersonV1, flags) == 32, "RoomcastPersonV1.flags");
_Static_assert(offsetof(RoomcastPersonV1, presence) == 36, "RoomcastPersonV1.presence");
_Static_assert(offsetof(RoomcastPersonV1, elsewhere) == 40, "RoomcastPersonV1.elsewhere");
_Static_assert(offsetof(RoomcastPersonV1, since_ns) == 48, "RoomcastPersonV1.since_ns");
_Static_assert(offsetof(RoomcastPersonV1, name) == 56, "RoomcastPersonV1.name");
_Static_assert(offsetof(RoomcastPersonV1, reserved) == 104, "RoomcastPersonV1.reserved");
_Static_assert(offsetof(RoomcastPersonV1, log_score_nats) == 128, "RoomcastPersonV1.log_score_nats");
_Static_assert(offsetof(RoomcastPersonV1, lower_log_score_nats) == 640, "RoomcastPersonV1.lower_log_score_nats");
_Static_assert(offsetof(RoomcastPersonV1, upper_log_score_nats) == 1152, "RoomcastPersonV1.upper_log_score_nats");
_Static_assert(offsetof(RoomcastPersonV1, probability) == 1664, "RoomcastPersonV1.probability");
_Static_assert(sizeof(RoomcastPersonScoresV1) == 20608, "RoomcastPersonScoresV1");
_Static_assert(offsetof(RoomcastPersonScoresV1, epoch) == 0, "RoomcastPersonScoresV1.epoch");
_Static_assert(offsetof(RoomcastPersonScoresV1, sequence) == 8, "RoomcastPersonScoresV1.sequence");
_Static_assert(offsetof(RoomcastPersonScoresV1, computed_ns) == 16, "RoomcastPersonScoresV1.computed_ns");
_Static_assert(offsetof(RoomcastPersonScoresV1, published_ns) == 24, "RoomcastPersonScoresV1.published_ns");
_Static_assert(offsetof(RoomcastPersonScoresV1, map_fingerprint) == 32, "RoomcastPersonScoresV1.map_fingerprint");
_Static_assert(offsetof(RoomcastPersonScoresV1, persons) == 64, "RoomcastPersonScoresV1.persons");
_Static_assert(offsetof(RoomcastPersonScoresV1, person_count) == 68, "RoomcastPersonScoresV1.person_count");
_Static_assert(offsetof(RoomcastPersonScoresV1, room_count) == 72, "RoomcastPersonScoresV1.room_count");
_Static_assert(offsetof(RoomcastPersonScoresV1, minor) == 76, "RoomcastPersonScoresV1.minor");
_Static_assert(offsetof(RoomcastPersonScoresV1, reserved) == 80, "RoomcastPersonScoresV1.reserved");
_Static_assert(offsetof(RoomcastPersonScoresV1, id) == 128, "RoomcastPersonScoresV1.id");
_Static_assert(offsetof(RoomcastPersonScoresV1, person) == 3200, "RoomcastPersonScoresV1.person");
_Static_assert(sizeof(RoomcastItemScoresHeaderV1) == 64, "RoomcastItemScoresHeaderV1");
_Static_assert(offsetof(RoomcastItemScoresHeaderV1, epoch) == 0, "RoomcastItemScoresHeaderV1.epoch");
_Static_assert(offsetof(RoomcastItemScoresHeaderV1, sequence) == 8, "RoomcastItemScoresHeaderV1.sequence");
_Static_assert(offsetof(RoomcastItemScoresHeaderV1, computed_ns) == 16, "RoomcastItemScoresHeaderV1.computed_ns");
_Static_assert(offsetof(RoomcastItemScoresHeaderV1, minor) == 24, "RoomcastItemScoresHeaderV1.minor");
_Static_assert(offsetof(RoomcastItemScoresHeaderV1, items) == 28, "RoomcastItemScoresHeaderV1.items");
_Static_assert(offsetof(RoomcastItemScoresHeaderV1, reserved) == 32, "RoomcastItemScoresHeaderV1.reserved");
_Static_assert(sizeof(RoomcastItemScoreV1) == 112, "RoomcastItemScoreV1");
_Static_assert(offsetof(RoomcastItemScoreV1, id) == 0, "RoomcastItemScoreV1.id");
_Static_assert(offsetof(RoomcastItemScoreV1, label) == 48, "RoomcastItemScoreV1.label");
_Static_assert(offsetof(RoomcastItemScoreV1, log_score_nats) == 96, "RoomcastItemScoreV1.log_score_nats");
_Static_assert(offsetof(RoomcastItemScoreV1, partition) == 104, "RoomcastItemScoreV1.partition");
_Static_assert(offsetof(RoomcastItemScoreV1, label_items) == 108, "RoomcastItemScoreV1.label_items");
_Static_assert(sizeof(RoomcastForecastV1) == 7360, "RoomcastForecastV1");
_Static_assert(offsetof(RoomcastForecastV1, epoch) == 0, "RoomcastForecastV1.epoch");
_Static_assert(offsetof(RoomcastForecastV1, sequence) == 8, "RoomcastForecastV1.sequence");
_Static_assert(offsetof(RoomcastForecastV1, computed_ns) == 16, "RoomcastForecastV1.computed_ns");
_Static_assert(offsetof(RoomcastForecastV1, published_ns) == 24, "RoomcastForecastV1.published_ns");
_Static_assert(offsetof(RoomcastForecastV1, room_count) == 32, "RoomcastForecastV1.room_count");
_Static_assert(offsetof(RoomcastForecastV1, horizon_count) == 36, "RoomcastForecastV1.horizon_count");
_Static_assert(offsetof(RoomcastForecastV1, person) == 40, "RoomcastForecastV1.person");
_Static_assert(offsetof(RoomcastForecastV1, minor) == 44, "RoomcastForecastV1.minor");
_Static_assert(offsetof(RoomcastForecastV1, flags) == 48, "RoomcastForecastV1.flags");
_Static_assert(offsetof(RoomcastForecastV1, elsewhere) == 52, "RoomcastForecastV1.elsewhere");
_Static_assert(offsetof(RoomcastForecastV1, reserved) == 116, "RoomcastForecastV1.reserved");
_Static_assert(offsetof(RoomcastForecastV1, horizon_s) == 128, "RoomcastForecastV1.horizon_s");
_Static_assert(offsetof(RoomcastForecastV1, id) == 192, "RoomcastForecastV1.id");
_Static_assert(offsetof(RoomcastForecastV1, probability) == 3264, "RoomcastForecastV1.probability");
_Static_assert(sizeof(RoomcastPersonForecastV1) == 4416, "RoomcastPersonForecastV1");
_Static_assert(offsetof(RoomcastPersonForecastV1, person) == 0, "RoomcastPersonForecastV1.person");
_Static_assert(offsetof(RoomcastPersonForecastV1, presence) == 4, "RoomcastPersonForecastV1.presence");
_Static_assert(offsetof(RoomcastPersonForecastV1, flags) == 8, "RoomcastPersonForecastV1.flags");
_Static_assert(offsetof(RoomcastPersonForecastV1, reserved_a) == 12, "RoomcastPersonForecastV1.reserved_a");
_Static_assert(offsetof(RoomcastPersonForecastV1, name) == 16, "RoomcastPersonForecastV1.name");
_Static_assert(offsetof(RoomcastPersonForecastV1, elsewhere) == 64, "RoomcastPersonForecastV1.elsewhere");
_Static_assert(offsetof(RoomcastPersonForecastV1, room_set) == 128, "RoomcastPersonForecastV1.room_set");
_Static_assert(offsetof(RoomcastPersonForecastV1, set_coverage) == 256, "RoomcastPersonForecastV1.set_coverage");
_Static_assert(offsetof(RoomcastPersonForecastV1, set_elsewhere) == 260, "RoomcastPersonForecastV1.set_elsewhere");
_Static_assert(offsetof(RoomcastPersonForecastV1, observations) == 264, "RoomcastPersonForecastV1.observations");
_Static_assert(offsetof(RoomcastPersonForecastV1, learned_share) == 268, "RoomcastPersonForecastV1.learned_share");
_Static_assert(offsetof(RoomcastPersonForecastV1, reserved) == 280, "RoomcastPersonForecastV1.reserved");
_Static_assert(offsetof(RoomcastPersonForecastV1, probability) == 320, "RoomcastPersonForecastV1.probability");
_Static_assert(sizeof(RoomcastPersonForecastsV1) == 38592, "RoomcastPersonForecastsV1");
_Static_assert(offsetof(RoomcastPersonForecastsV1, epoch) == 0, "RoomcastPersonForecastsV1.epoch");
_Static_assert(offsetof(RoomcastPersonForecastsV1, sequence) == 8, "RoomcastPersonForecastsV1.sequence");
_Static_assert(offsetof(RoomcastPersonForecastsV1, computed_ns) == 16, "RoomcastPersonForecastsV1.computed_ns");
_Static_assert(offsetof(RoomcastPersonForecastsV1, published_ns) == 24, "RoomcastPersonForecastsV1.published_ns");
_Static_assert(offsetof(RoomcastPersonForecastsV1, room_count) == 32, "RoomcastPersonForecastsV1.room_count");
_Static_assert(offsetof(RoomcastPersonForecastsV1, horizon_count) == 36, "RoomcastPersonForecastsV1.horizon_count");
_Static_assert(offsetof(RoomcastPersonForecastsV1, persons) == 40, "RoomcastPersonForecastsV1.persons");
_Static_assert(offsetof(RoomcastPersonForecastsV1, person_count) == 44, "RoomcastPersonForecastsV1.person_count");
_Static_assert(offsetof(RoomcastPersonForecastsV1, minor) == 48, "RoomcastPersonForecastsV1.minor");
_Static_assert(offsetof(RoomcastPersonForecastsV1, reserved) == 52, "RoomcastPersonForecastsV1.reserved");
_Static_assert(offsetof(RoomcastPersonForecastsV1, horizon_s) == 128, "RoomcastPersonForecastsV1.horizon_s");
_Static_assert(offsetof(RoomcastPersonForecastsV1, id) == 192, "RoomcastPersonForecastsV1.id");
_Static_assert(offsetof(RoomcastPersonForecastsV1, person) == 3264, "RoomcastPersonForecastsV1.person");
_Static_assert(sizeof(RoomcastDecisionV1) == 768, "RoomcastDecisionV1");
_Static_assert(offsetof(RoomcastDecisionV1, robot) == 0, "RoomcastDecisionV1.robot");
_Static_assert(offsetof(RoomcastDecisionV1, epoch) == 8, "RoomcastDecisionV1.epoch");
_Static_assert(offsetof(RoomcastDecisionV1, sequence) == 16, "RoomcastDecisionV1.sequence");
_Static_assert(offsetof(RoomcastDecisionV1, decided_ns) == 24, "RoomcastDecisionV1.decided_ns");
_Static_assert(offsetof(RoomcastDecisionV1, decided_unix_ns) == 32, "RoomcastDecisionV1.decided_unix_ns");
_Static_assert(offsetof(RoomcastDecisionV1, scores_epoch) == 40, "RoomcastDecisionV1.scores_epoch");
_Static_assert(offsetof(RoomcastDecisionV1, scores_sequence) == 48, "RoomcastDecisionV1.scores_sequence");
_Static_assert(offsetof(RoomcastDecisionV1, scores_age_ns) == 56, "RoomcastDecisionV1.scores_age_ns");
_Static_assert(offsetof(RoomcastDecisionV1, observed_ns) == 64, "RoomcastDecisionV1.observed_ns");
_Static_assert(offsetof(RoomcastDecisionV1, covered) == 72, "RoomcastDecisionV1.covered");
_Static_assert(offsetof(RoomcastDecisionV1, probability) == 80, "RoomcastDecisionV1.probability");
_Static_assert(offsetof(RoomcastDecisionV1, stay_ns) == 88, "RoomcastDecisionV1.stay_ns");
_Static_assert(offsetof(RoomcastDecisionV1, action) == 96, "RoomcastDecisionV1.action");
_Static_assert(offsetof(RoomcastDecisionV1, flags) == 100, "RoomcastDecisionV1.flags");
_Static_assert(offsetof(RoomcastDecisionV1, minor) == 104, "RoomcastDecisionV1.minor");
_Static_assert(offsetof(RoomcastDecisionV1, reserved_a) == 108, "RoomcastDecisionV1.reserved_a");
_Static_assert(offsetof(RoomcastDecisionV1, from) == 112, "RoomcastDecisionV1.from");
_Static_assert(offsetof(RoomcastDecisionV1, to) == 160, "RoomcastDecisionV1.to");
_Static_assert(offsetof(RoomcastDecisionV1, policy) == 208, "RoomcastDecisionV1.policy");
_Static_assert(offsetof(RoomcastDecisionV1, reason) == 256, "RoomcastDecisionV1.reason");
_Static_assert(offsetof(RoomcastDecisionV1, cancels) == 512, "RoomcastDecisionV1.cancels");
_Static_assert(offsetof(RoomcastDecisionV1, robot_name) == 520, "RoomcastDecisionV1.robot_name");
_Static_assert(offsetof(RoomcastDecisionV1, held_until_unix_ns) == 568, "RoomcastDecisionV1.held_until_unix_ns");
_Static_assert(offsetof(RoomcastDecisionV1, cleaned_min) == 576, "RoomcastDecisionV1.cleaned_min");
_Static_assert(offsetof(RoomcastDecisionV1, reserved) == 704, "RoomcastDecisionV1.reserved");
_Static_assert(sizeof(RoomcastRobotReportV1) == 512, "RoomcastRobotReportV1");
_Static_assert(offsetof(RoomcastRobotReportV1, robot) == 0, "RoomcastRobotReportV1.robot");
_Static_assert(offsetof(RoomcastRobotReportV1, epoch) == 8, "RoomcastRobotReportV1.epoch");
_Static_assert(offsetof(RoomcastRobotReportV1, sequence) == 16, "RoomcastRobotReportV1.sequence");
_Static_assert(offsetof(RoomcastRobotReportV1, reported_ns) == 24, "RoomcastRobotReportV1.reported_ns");
_Static_assert(offsetof(RoomcastRobotReportV1, reported_unix_ns) == 32, "RoomcastRobotReportV1.reported_unix_ns");
_Static_assert(offsetof(RoomcastRobotReportV1, decision_epoch) == 40, "RoomcastRobotReportV1.decision_epoch");
_Static_assert(offsetof(RoomcastRobotReportV1, decision_sequence) == 48, "RoomcastRobotReportV1.decision_sequence");
_Static_assert(offsetof(RoomcastRobotReportV1, position_m) == 56, "RoomcastRobotReportV1.position_m");
_Static_assert(offsetof(RoomcastRobotReportV1, battery) == 80, "RoomcastRobotReportV1.battery");
_Static_assert(offsetof(RoomcastRobotReportV1, kind) == 88, "RoomcastRobotReportV1.kind");
_Static_assert(offsetof(RoomcastRobotReportV1, flags) == 92, "RoomcastRobotReportV1.flags");
_Static_assert(offsetof(RoomcastRobotReportV1, minor) == 96, "RoomcastRobotReportV1.minor");
_Static_assert(offsetof(RoomcastRobotReportV1, reserved_a) == 100, "RoomcastRobotReportV1.reserved_a");
_Static_assert(offsetof(RoomcastRobotReportV1, robot_name) == 104, "RoomcastRobotReportV1.robot_name");
_Static_assert(offsetof(RoomcastRobotReportV1, room) == 152, "RoomcastRobotReportV1.room");
_Static_assert(offsetof(RoomcastRobotReportV1, note) == 200, "RoomcastRobotReportV1.note");
_Static_assert(offsetof(RoomcastRobotReportV1, until_unix_ns) == 320, "RoomcastRobotReportV1.until_unix_ns");
_Static_assert(offsetof(RoomcastRobotReportV1, reserved) == 328, "RoomcastRobotReportV1.reserved");
_Static_assert(sizeof(RoomcastStatusRequestV1) == 16, "RoomcastStatusRequestV1");
_Static_assert(offsetof(RoomcastStatusRequestV1, minor) == 0, "RoomcastStatusRequestV1.minor");
_Static_assert(offsetof(RoomcastStatusRequestV1, reserved) == 4, "RoomcastStatusRequestV1.reserved");
_Static_assert(sizeof(RoomcastStatusResponseV1) == 512, "RoomcastStatusResponseV1");
_Static_assert(offsetof(RoomcastStatusResponseV1, epoch) == 0, "RoomcastStatusResponseV1.epoch");
_Static_assert(offsetof(RoomcastStatusResponseV1, sequence) == 8, "RoomcastStatusResponseV1.sequence");
_Static_assert(offsetof(RoomcastStatusResponseV1, started_unix_ns) == 16, "RoomcastStatusResponseV1.started_unix_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, answered_ns) == 24, "RoomcastStatusResponseV1.answered_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, received) == 32, "RoomcastStatusResponseV1.received");
_Static_assert(offsetof(RoomcastStatusResponseV1, accepted) == 40, "RoomcastStatusResponseV1.accepted");
_Static_assert(offsetof(RoomcastStatusResponseV1, duplicates) == 48, "RoomcastStatusResponseV1.duplicates");
_Static_assert(offsetof(RoomcastStatusResponseV1, missed) == 56, "RoomcastStatusResponseV1.missed");
_Static_assert(offsetof(RoomcastStatusResponseV1, malformed) == 64, "RoomcastStatusResponseV1.malformed");
_Static_assert(offsetof(RoomcastStatusResponseV1, limited) == 72, "RoomcastStatusResponseV1.limited");
_Static_assert(offsetof(RoomcastStatusResponseV1, steps) == 80, "RoomcastStatusResponseV1.steps");
_Static_assert(offsetof(RoomcastStatusResponseV1, merged) == 88, "RoomcastStatusResponseV1.merged");
_Static_assert(offsetof(RoomcastStatusResponseV1, failed_steps) == 96, "RoomcastStatusResponseV1.failed_steps");
_Static_assert(offsetof(RoomcastStatusResponseV1, published) == 104, "RoomcastStatusResponseV1.published");
_Static_assert(offsetof(RoomcastStatusResponseV1, heartbeats) == 112, "RoomcastStatusResponseV1.heartbeats");
_Static_assert(offsetof(RoomcastStatusResponseV1, restored) == 120, "RoomcastStatusResponseV1.restored");
_Static_assert(offsetof(RoomcastStatusResponseV1, waiting) == 128, "RoomcastStatusResponseV1.waiting");
_Static_assert(offsetof(RoomcastStatusResponseV1, latency_p50_ns) == 136, "RoomcastStatusResponseV1.latency_p50_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, latency_p99_ns) == 144, "RoomcastStatusResponseV1.latency_p99_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, latency_max_ns) == 152, "RoomcastStatusResponseV1.latency_max_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, model_fingerprint) == 160, "RoomcastStatusResponseV1.model_fingerprint");
_Static_assert(offsetof(RoomcastStatusResponseV1, map_fingerprint) == 192, "RoomcastStatusResponseV1.map_fingerprint");
_Static_assert(offsetof(RoomcastStatusResponseV1, process) == 224, "RoomcastStatusResponseV1.process");
_Static_assert(offsetof(RoomcastStatusResponseV1, sources) == 228, "RoomcastStatusResponseV1.sources");
_Static_assert(offsetof(RoomcastStatusResponseV1, persons) == 232, "RoomcastStatusResponseV1.persons");
_Static_assert(offsetof(RoomcastStatusResponseV1, minor) == 236, "RoomcastStatusResponseV1.minor");
_Static_assert(offsetof(RoomcastStatusResponseV1, version) == 240, "RoomcastStatusResponseV1.version");
_Static_assert(offsetof(RoomcastStatusResponseV1, map) == 288, "RoomcastStatusResponseV1.map");
_Static_assert(offsetof(RoomcastStatusResponseV1, model) == 336, "RoomcastStatusResponseV1.model");
_Static_assert(offsetof(RoomcastStatusResponseV1, journal_bytes) == 384, "RoomcastStatusResponseV1.journal_bytes");
_Static_assert(offsetof(RoomcastStatusResponseV1, journal_failures) == 392, "RoomcastStatusResponseV1.journal_failures");
_Static_assert(offsetof(RoomcastStatusResponseV1, forged) == 400, "RoomcastStatusResponseV1.forged");
_Static_assert(offsetof(RoomcastStatusResponseV1, costly) == 408, "RoomcastStatusResponseV1.costly");
_Static_assert(offsetof(RoomcastStatusResponseV1, learned) == 416, "RoomcastStatusResponseV1.learned");
_Static_assert(offsetof(RoomcastStatusResponseV1, habits_bytes) == 424, "RoomcastStatusResponseV1.habits_bytes");
_Static_assert(offsetof(RoomcastStatusResponseV1, habits_counts) == 432, "RoomcastStatusResponseV1.habits_counts");
_Static_assert(offsetof(RoomcastStatusResponseV1, habits_names) == 440, "RoomcastStatusResponseV1.habits_names");
_Static_assert(offsetof(RoomcastStatusResponseV1, habits_persons) == 444, "RoomcastStatusResponseV1.habits_persons");
_Static_assert(offsetof(RoomcastStatusResponseV1, asked) == 448, "RoomcastStatusResponseV1.asked");
_Static_assert(offsetof(RoomcastStatusResponseV1, prepared) == 456, "RoomcastStatusResponseV1.prepared");
_Static_assert(offsetof(RoomcastStatusResponseV1, prepared_used) == 464, "RoomcastStatusResponseV1.prepared_used");
_Static_assert(offsetof(RoomcastStatusResponseV1, prepare_ns) == 472, "RoomcastStatusResponseV1.prepare_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, ahead) == 480, "RoomcastStatusResponseV1.ahead");
_Static_assert(offsetof(RoomcastStatusResponseV1, ahead_ns) == 488, "RoomcastStatusResponseV1.ahead_ns");
_Static_assert(offsetof(RoomcastStatusResponseV1, reserved) == 496, "RoomcastStatusResponseV1.reserved");
#endif
