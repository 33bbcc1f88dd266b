-- A visitor can go more than once: each departure counts at its own place among the events.
ALTER TABLE departure RENAME TO last_departure;
CREATE TABLE departure (person INTEGER NOT NULL, after INTEGER NOT NULL, PRIMARY KEY (person, after)) WITHOUT ROWID, STRICT;
INSERT INTO departure SELECT person, after FROM last_departure;
DROP TABLE last_departure;
