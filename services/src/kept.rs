//! Small values that outlive a process, in a separate SQLite database: a table for each value, with a row of JSON for each field.

use std::collections::BTreeMap;
use std::path::PathBuf;

use roomcast_database::rusqlite::params;
use roomcast_database::{Connection, Database, DatabaseError, Schema, WAL_BYTES_MAX, rusqlite};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::clock;
use crate::logging::Limiter;

/// The interval of warnings about a database that cannot be written.
const COMPLAINT_NS: u64 = 60_000_000_000;

/// The values of a process.
#[derive(Debug)]
pub(crate) struct Kept {
    path: PathBuf,
    schema: Schema,
    /// `None` before the first use, and after a failure.
    database: Option<Database>,
    /// Values in the database, by table.
    written: BTreeMap<&'static str, Map<String, Value>>,
    log: Limiter,
}

impl Kept {
    pub(crate) fn new(path: PathBuf, schema: Schema) -> Self {
        Self { path, schema, database: None, written: BTreeMap::new(), log: Limiter::new(COMPLAINT_NS) }
    }

    /// The value in a table; `None` if it was never written. Damage costs the value, and the log says so.
    pub(crate) fn load<T: DeserializeOwned>(&mut self, table: &str) -> Option<T> {
        self.try_load(table).unwrap_or_else(|reason| {
            tracing::warn!(reason, path = %self.path.display(), "the {table} of the process before cannot be read: it begins again");
            None
        })
    }

    fn try_load<T: DeserializeOwned>(&mut self, table: &str) -> Result<Option<T>, String> {
        let database = self.open().map_err(|error| error.to_string())?;
        let rows = database.connection().and_then(|connection| rows(connection, table));
        let value =
            rows.map_err(|error| error.to_string())?.map(|fields| serde_json::from_value(Value::Object(fields)));
        value.transpose().map_err(|error| error.to_string())
    }

    /// Writes a changed value. If `is_synced`, it survives a power loss. After a failure the next call tries again. The log warns with `loss`, the cost
    /// and the remedy, once a minute.
    pub(crate) fn keep(&mut self, table: &'static str, value: &impl Serialize, is_synced: bool, loss: &str) {
        let Ok(Value::Object(fields)) = serde_json::to_value(value) else { return };
        if self.written.get(table) == Some(&fields) {
            return;
        }
        match self.write(table, &fields, is_synced) {
            Ok(()) => _ = self.written.insert(table, fields),
            Err(error) => {
                // The next call opens the database again, and writes all values.
                (self.database, self.written) = (None, BTreeMap::new());
                if let Some(not_told) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, not_told, "{loss}");
                }
            }
        }
    }

    fn open(&mut self) -> Result<&mut Database, DatabaseError> {
        if self.database.is_none() {
            self.database = Some(Database::open(&self.path, self.schema)?);
        }
        self.database.as_mut().ok_or_else(|| DatabaseError::Locked(self.path.clone()))
    }

    fn write(&mut self, table: &str, fields: &Map<String, Value>, is_synced: bool) -> Result<(), DatabaseError> {
        let path = self.path.clone();
        let database = self.open()?;
        let work = |transaction: &rusqlite::Transaction<'_>| {
            transaction.execute(&format!("DELETE FROM {table}"), [])?;
            let mut insert = transaction.prepare_cached(&format!("INSERT INTO {table} VALUES (?1, ?2)"))?;
            fields.iter().try_for_each(|(field, value)| insert.execute(params![field, value.to_string()]).map(|_| ()))
        };
        let is_long = database.bytes() > 2 * WAL_BYTES_MAX;
        let written = if is_synced || is_long { database.write_synced(work) } else { database.write(work) };
        written.map_err(|source| DatabaseError::Sqlite(path, source))
    }
}

/// The value in a table of another process's database.
#[cfg(any(feature = "mqtt", test))]
pub(crate) fn read<T: DeserializeOwned>(path: &std::path::Path, table: &str) -> Option<T> {
    let fields = rows(&roomcast_database::look(path).ok()?, table).ok()??;
    serde_json::from_value(Value::Object(fields)).ok()
}

/// The fields of a value; `None` if it was never written.
fn rows(connection: &Connection, table: &str) -> rusqlite::Result<Option<Map<String, Value>>> {
    let mut query = connection.prepare(&format!("SELECT field, value FROM {table}"))?;
    let field = |row: &rusqlite::Row<'_>| Ok((row.get(0)?, row.get::<_, String>(1)?));
    let fields = query.query_map([], field)?.collect::<rusqlite::Result<Vec<(String, String)>>>()?;
    // Damaged JSON is a text, which the value's type refuses.
    let value = |text: String| serde_json::from_str(&text).unwrap_or(Value::String(text));
    Ok((!fields.is_empty()).then(|| fields.into_iter().map(|(field, text)| (field, value(text))).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCHEMA: Schema = Schema {
        application: 1,
        migrations: &["CREATE TABLE counts (field TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID, STRICT"],
    };

    #[derive(Debug, Clone, PartialEq, Serialize, serde::Deserialize)]
    struct Counts {
        first: u32,
        last: Option<f64>,
    }

    #[test]
    fn values_outlive_the_process_and_a_blocked_folder() {
        let outer = tempfile::tempdir().unwrap();
        let folder = outer.path().join("state");
        let path = folder.join("counts.db");
        let open = || Kept::new(path.clone(), SCHEMA);
        std::fs::write(&folder, "in the way").unwrap();
        let mut kept = open();
        assert_eq!(kept.load::<Counts>("counts"), None, "the folder cannot be made");
        let value = Counts { first: 2, last: Some(0.1) };
        kept.keep("counts", &value, true, "it is not kept");
        std::fs::remove_file(&folder).unwrap();
        kept.keep("counts", &value, false, "it is not kept");
        assert_eq!(read(&path, "counts"), Some(value.clone()));
        let mut next = open();
        assert_eq!(next.load::<Counts>("counts"), None, "another process has it");
        drop(kept);
        assert_eq!(next.load("counts"), Some(value));
        let database = Connection::open(&path).unwrap();
        database.execute("UPDATE counts SET value = '{' WHERE field = 'last'", []).unwrap();
        assert_eq!(next.load::<Counts>("counts"), None, "damaged");
    }
}
