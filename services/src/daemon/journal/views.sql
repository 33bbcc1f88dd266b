-- The newest name of each person; a name that the home gave comes before the others.
CREATE VIEW person_name AS
SELECT number, name, max(rank) AS rank FROM (
    SELECT number, name, 9223372036854775807 AS rank FROM person
    UNION ALL SELECT number, name, id FROM event WHERE name IS NOT NULL
    UNION ALL SELECT person, name, event FROM moved WHERE name IS NOT NULL)
GROUP BY number;

-- A row for each person of an event. `at` is in seconds since 1970; a person without a name is a number.
CREATE VIEW person_event AS
SELECT event.id AS event, event.observed_unix_ns / 1000000000 AS at,
       coalesce(person_name.name, nullif(coalesce(moved.person, event.found, event.number), 4294967295)) AS person,
       coalesce(moved.kind, event.kind) AS kind,
       CASE WHEN moved.kind IS NULL THEN event.room ELSE moved.room END AS room,
       CASE WHEN moved.kind IS NULL THEN event.text ELSE moved.text END AS text
FROM event LEFT JOIN moved ON moved.event = event.id
LEFT JOIN person_name ON person_name.number = coalesce(moved.person, event.found, event.number);

-- A row for each person and room that an event names: in `room`, or in its text if another event has this room.
CREATE VIEW person_room AS
SELECT event, at, person, known.room AS room FROM person_event
JOIN (SELECT room FROM event WHERE room IS NOT NULL UNION SELECT room FROM moved WHERE room IS NOT NULL) AS known
ON known.room = person_event.room
   OR (kind = 'did' AND person_event.room IS NULL AND instr(lower(text), lower(known.room)) > 0)
WHERE person IS NOT NULL AND kind IN ('present', 'did', 'sensor');
