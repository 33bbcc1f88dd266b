-- A row for each context, whose eight bytes are the columns of `habit_count` but the last three. `counts` is a JSON list of pairs of symbol and count.
ALTER TABLE habit RENAME TO former_habit;
CREATE TABLE habit (context INTEGER PRIMARY KEY, touched_min INTEGER NOT NULL, counts TEXT NOT NULL) STRICT;
INSERT OR IGNORE INTO habit
SELECT (kind << 56) | (slot << 48) | (after_1 << 32) | (after_2 << 16) | after_3, touched_min, json_group_array(json_array(symbol, count))
FROM former_habit GROUP BY kind, slot, after_1, after_2, after_3;
DROP TABLE former_habit;

-- A row for each count.
CREATE VIEW habit_count AS
SELECT context >> 56 AS kind, (context >> 48) & 255 AS slot, (context >> 32) & 65535 AS after_1, (context >> 16) & 65535 AS after_2,
       context & 65535 AS after_3, value ->> 0 AS symbol, value ->> 1 AS count, touched_min
FROM habit, json_each(counts);
