-- The map in use, as JSON, if a request has changed the configured scene; with the fingerprints of both.
CREATE TABLE changed_map (scene TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, map TEXT NOT NULL) WITHOUT ROWID, STRICT;
