-- The newest events. The oldest go first; the last ones of each person stay.
CREATE TABLE event (
    id INTEGER PRIMARY KEY,
    source INTEGER NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL,
    -- Of the monotonic clock; null for an event from before the last start of the machine.
    observed_ns INTEGER,
    observed_unix_ns INTEGER NOT NULL,
    -- did, present, away, gone, all-away, empty, sensor; the text of a sensor is its report as JSON.
    kind TEXT NOT NULL,
    room TEXT, text TEXT,
    -- As the narrator gave them; 4294967295 is somebody.
    person INTEGER NOT NULL, name TEXT,
    -- The person that the narrator means: the number, or the one that follows from the name.
    number INTEGER,
    -- The person that the daemon attributed it to.
    found INTEGER,
    -- Persons that the narrator counted; 0 if it counted none.
    count INTEGER NOT NULL,
    may_be_form INTEGER NOT NULL,
    -- The table `moved` has its persons.
    is_told INTEGER NOT NULL DEFAULT 0,
    -- CRC-32 of the narrator's words, plus `found` (0 if null, else one more), plus the remainder of `observed_ns` by 1000000007.
    checksum INTEGER NOT NULL,
    UNIQUE (source, epoch, sequence)
) STRICT;

-- The persons that an event moved, in their order.
CREATE TABLE moved (
    event INTEGER NOT NULL REFERENCES event ON DELETE CASCADE, place INTEGER NOT NULL,
    person INTEGER NOT NULL, name TEXT, by_fit INTEGER NOT NULL,
    -- Null when it is the event itself.
    kind TEXT, room TEXT, text TEXT,
    PRIMARY KEY (event, place)
) WITHOUT ROWID, STRICT;

-- Per room the probability (f32, little endian) that the person goes there next, or, with paces, that they were there when the map changed.
CREATE TABLE expectation (
    event INTEGER NOT NULL REFERENCES event ON DELETE CASCADE, person INTEGER NOT NULL, is_belief INTEGER NOT NULL,
    map INTEGER NOT NULL, paces BLOB, probability BLOB NOT NULL,
    PRIMARY KEY (event, person, is_belief)
) WITHOUT ROWID, STRICT;

-- Persons who were forgotten, or visitors who are gone by silence, after an event.
CREATE TABLE departure (person INTEGER PRIMARY KEY, after INTEGER NOT NULL) STRICT;

-- Each start of a narrator: its port, its last sequence number, the last one of an event that is gone, and its last event.
CREATE TABLE source (
    source INTEGER NOT NULL, epoch INTEGER NOT NULL, port BLOB, last INTEGER, settled INTEGER,
    event INTEGER NOT NULL,
    -- CRC-32 of the other columns.
    checksum INTEGER NOT NULL,
    PRIMARY KEY (source, epoch)
) WITHOUT ROWID, STRICT;

-- The names that habits know, by kind ('thing' or 'place') and number.
CREATE TABLE habit_name (kind TEXT NOT NULL, number INTEGER NOT NULL, name TEXT NOT NULL, seen_min INTEGER NOT NULL, PRIMARY KEY (kind, number))
WITHOUT ROWID, STRICT;

-- The habits' model of a person, as JSON; its `slot` is the person in the lower six bits of `habit_count.slot`.
CREATE TABLE habit_person (person INTEGER PRIMARY KEY, model TEXT NOT NULL) STRICT;

-- How often a symbol followed a context, with a half-life, as of the minute of the last change.
CREATE TABLE habit (
    kind INTEGER NOT NULL, slot INTEGER NOT NULL, after_1 INTEGER NOT NULL, after_2 INTEGER NOT NULL, after_3 INTEGER NOT NULL,
    symbol INTEGER NOT NULL, count REAL NOT NULL, touched_min INTEGER NOT NULL,
    PRIMARY KEY (kind, slot, after_1, after_2, after_3, symbol)
) WITHOUT ROWID, STRICT;

-- The last learned event of each start of a narrator: habits learn no event twice.
CREATE TABLE learned (source INTEGER NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, place INTEGER NOT NULL, PRIMARY KEY (source, epoch))
WITHOUT ROWID, STRICT;

-- The names that the home gave; `resident` is null where the configuration decides. `former` is a JSON list of earlier names.
CREATE TABLE person (number INTEGER PRIMARY KEY, name TEXT NOT NULL, resident INTEGER, former TEXT NOT NULL, place INTEGER NOT NULL) STRICT;
