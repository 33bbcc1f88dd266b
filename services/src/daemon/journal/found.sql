-- The checksum tells a person with the number 0 from none.
UPDATE event SET checksum = checksum + 1 WHERE found IS NOT NULL;
