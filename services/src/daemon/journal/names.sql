-- Names have no date: each event wrote one, and no reader needs it.
ALTER TABLE habit_name DROP COLUMN seen_min;
