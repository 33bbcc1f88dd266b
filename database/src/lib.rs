//! One SQLite file that belongs to one process: opened safely, migrated, and set aside when it is damaged.
//!
//! A commit outlives the process at once. It outlives a power loss after the next [`Database::write_synced`]. The write-ahead log is copied into the file
//! when it has more than [`WAL_BYTES_MAX`], so both are bounded by what the tables hold.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use roomcast_ipc::own_file::require_own;
use rusqlite::config::DbConfig;
use rusqlite::types::Value;
pub use rusqlite::{self, Connection, Transaction};
use rusqlite::{ErrorCode, OpenFlags, TransactionBehavior, params_from_iter};
use rustix::fs::FlockOperation;

/// Size of the write-ahead log at which it is copied into the file.
pub const WAL_BYTES_MAX: u64 = 1 << 20;
/// Most damaged databases that are kept.
const ASIDE_MAX: usize = 16;
const PAGE_BYTES: u32 = 2048;
/// A file locked for longer is another process's. Until a child of this process runs its own program, it has the locks of this one.
const LOCKED_FOR: Duration = Duration::from_millis(250);

/// The content of a database, in addition to the table `meta` of keys and values.
#[derive(Debug, Clone, Copy)]
pub struct Schema {
    /// Marks the file, so that another program's database is not mistaken for it.
    pub application: i32,
    /// The statements from each version to the next. A file's version is the number of applied ones.
    pub migrations: &'static [&'static str],
}

impl Schema {
    fn version(&self) -> i64 {
        self.migrations.len() as i64
    }
}

/// A database that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatabaseError {
    /// An operation on the file or its folder failed, such as "open" or "lock".
    #[error("database {}: cannot {} it: {}; check owner, mode and space of its folder", .0.display(), .1, .2)]
    File(PathBuf, &'static str, #[source] io::Error),
    /// Another user could have created or may change it.
    #[error("database {}: {}", .0.display(), .1)]
    Refused(PathBuf, #[source] io::Error),
    /// Another process has it.
    #[error("database {}: another process uses it; stop that process, or give this one another directory", .0.display())]
    Locked(PathBuf),
    /// A newer version of the program has written it: its schema, and the newest one that is known here.
    #[error(
        "database {}: a newer version of Roomcast has written it (schema {}; this one knows {}); start that version, or move the file away with its -wal file",
        .0.display(), .1, .2
    )]
    Newer(PathBuf, i64, i64),
    /// SQLite reports an error.
    #[error("database {}: {}; check the disk and its space", .0.display(), reason(.1))]
    Sqlite(PathBuf, rusqlite::Error),
}

/// The place of a database.
#[derive(Debug)]
enum Place {
    /// In a file. The lock lasts while this is open.
    File(File),
    /// On a simulated disk of a test.
    Simulated(Simulation),
}

/// A simulated disk: a VFS that is registered with SQLite.
#[derive(Debug, Clone, Copy)]
pub struct Simulation {
    /// The name of the VFS.
    pub vfs: &'static str,
    /// Removes a damaged database.
    pub set_aside: fn(),
}

/// The tables of a damaged database.
#[derive(Debug, Default)]
struct Salvaged {
    /// Each with the number of rows that were copied.
    rows: Vec<String>,
    /// Those with rows that could not be read.
    incomplete: Vec<String>,
}

/// A database of this process.
#[derive(Debug)]
pub struct Database {
    /// `None` only during reopening.
    connection: Option<Connection>,
    path: PathBuf,
    schema: Schema,
    place: Place,
}

impl Database {
    /// Opens or creates the database, and its folder for its owner alone. A damaged database is set aside, and a new one begins.
    ///
    /// # Errors
    /// [`DatabaseError`]; damage is no error.
    pub fn open(path: &Path, schema: Schema) -> Result<Self, DatabaseError> {
        // SQLite follows no links: only the folder may have some.
        let folder = path.parent().unwrap_or(Path::new("."));
        let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(folder);
        made.map_err(failed(path, "make the folder of"))?;
        let folder = fs::canonicalize(folder).map_err(failed(folder, "find"))?;
        let path = folder.join(path.file_name().unwrap_or_default());
        let place = Place::File(lock(&path)?);
        Self::open_at(path, schema, place)
    }

    /// The same on a simulated disk.
    ///
    /// # Errors
    /// As [`Database::open`].
    pub fn open_simulated(simulation: Simulation, schema: Schema) -> Result<Self, DatabaseError> {
        Self::open_at(PathBuf::from("simulated"), schema, Place::Simulated(simulation))
    }

    fn open_at(path: PathBuf, schema: Schema, place: Place) -> Result<Self, DatabaseError> {
        let mut database = Self { connection: None, path, schema, place };
        database.reopen()?;
        Ok(database)
    }

    /// Closes and reopens it, as after a kill. A damaged database is set aside, and a new one begins.
    ///
    /// # Errors
    /// [`DatabaseError`]; the next call tries again.
    pub fn reopen(&mut self) -> Result<(), DatabaseError> {
        self.connection = None;
        // A single read may be wrong, so the second attempt decides. SQLite opens a newer file format read-only, although this file is writable.
        let connected = self.connect().or_else(|error| match &error {
            DatabaseError::Sqlite(path, source)
                if source.sqlite_error_code() == Some(ErrorCode::ReadOnly) && self.is_writable() =>
            {
                Err(DatabaseError::Sqlite(path.clone(), damaged(&source.to_string())))
            }
            DatabaseError::Sqlite(_, source) if is_damage(source) => self.connect(),
            _ => Err(error),
        });
        match connected {
            Ok(connection) => self.connection = Some(connection),
            Err(DatabaseError::Sqlite(_, error)) if is_damage(&error) => self.start_anew(&error)?,
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Sets a damaged database aside, and begins a new one with the rows that can be read. The log says so.
    ///
    /// # Errors
    /// [`DatabaseError`].
    pub fn start_anew(&mut self, damage: &rusqlite::Error) -> Result<(), DatabaseError> {
        self.connection = None;
        let aside = self.move_aside()?;
        self.connection = Some(self.connect()?);
        let salvaged = self.salvage(&aside).unwrap_or_default();
        let [rows, incomplete] = [salvaged.rows, salvaged.incomplete].map(|tables| tables.join(", "));
        tracing::error!(
            path = %aside.display(), reason = %damage, rows, incomplete,
            "a damaged database was set aside, and a new one has the rows that could be read, which are not all of the incomplete tables; is the disk failing?"
        );
        Ok(())
    }

    /// Copies the rows of a damaged database of the same version, from both ends of each table as far as they can be read.
    fn salvage(&mut self, path: &Path) -> rusqlite::Result<Salvaged> {
        let damaged =
            Connection::open_with_flags(path, OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX)?;
        damaged.set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, true)?;
        // Otherwise SQLite refuses all pages of a file that lacks its last one.
        damaged.pragma_update(None, "writable_schema", true)?;
        let (application, version) = version(&damaged)?;
        let known = self.schema.version();
        if application != self.schema.application || ![Some(version), noted_version(&damaged)].contains(&Some(known)) {
            return Ok(Salvaged::default());
        }
        self.write(|transaction| {
            // In this order a table follows the tables that it references.
            let mut query =
                transaction.prepare("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY rowid")?;
            let tables: Vec<String> = query.query_map([], |row| row.get(0))?.collect::<rusqlite::Result<_>>()?;
            let mut salvaged = Salvaged::default();
            for table in tables {
                let mut copied = 0;
                let is_whole =
                    ["ASC", "DESC"].iter().any(|order| copy(&damaged, transaction, &table, order, &mut copied).is_ok());
                salvaged.rows.push(format!("{table} {copied}"));
                if !is_whole {
                    salvaged.incomplete.push(table);
                }
            }
            Ok(salvaged)
        })
    }

    fn connect(&self) -> Result<Connection, DatabaseError> {
        let failed = |source| DatabaseError::Sqlite(self.path.clone(), source);
        let mut connection = self.connect_checked().map_err(failed)?;
        match self.migrate(&mut connection).map_err(failed)? {
            Some(newer) => Err(DatabaseError::Newer(self.path.clone(), newer, self.schema.version())),
            None => Ok(connection),
        }
    }

    fn connect_checked(&self) -> rusqlite::Result<Connection> {
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE
            | OpenFlags::SQLITE_OPEN_CREATE
            | OpenFlags::SQLITE_OPEN_NO_MUTEX
            | OpenFlags::SQLITE_OPEN_NOFOLLOW;
        let connection = match &self.place {
            Place::File(_) => {
                // SQLite gives its files the mode of this one. If it cannot be made, SQLite says why.
                let _made = own_file(&self.path);
                Connection::open_with_flags(&self.path, flags)?
            }
            Place::Simulated(disk) => Connection::open_with_flags_and_vfs(&self.path, flags, disk.vfs)?,
        };
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, true)?;
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
        connection.busy_timeout(Duration::from_millis(200))?;
        connection.set_prepared_statement_cache_capacity(64);
        if matches!(self.place, Place::Simulated(_)) {
            // The simulated VFS has no shared memory.
            connection.pragma_update(None, "locking_mode", "exclusive")?;
        }
        connection.execute_batch(&format!(
            "PRAGMA page_size = {PAGE_BYTES}; PRAGMA cell_size_check = on; PRAGMA secure_delete = on; PRAGMA temp_store = memory;
             PRAGMA foreign_keys = on; PRAGMA synchronous = normal; PRAGMA wal_autocheckpoint = 0;
             PRAGMA journal_size_limit = {WAL_BYTES_MAX};"
        ))?;
        connection.pragma_update_and_check(None, "journal_mode", "wal", |row| row.get::<_, String>(0))?;
        let check: String = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
        if check != "ok" {
            return Err(damaged(&check));
        }
        Ok(connection)
    }

    /// Brings the schema to the known version. Gives the version of a newer one, which stays as it is.
    fn migrate(&self, connection: &mut Connection) -> rusqlite::Result<Option<i64>> {
        let (Schema { application, migrations }, known) = (self.schema, self.schema.version());
        let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let (found, version) = version(&transaction)?;
        if ![(0, 0), (application, version)].contains(&(found, version)) {
            return Err(damaged("it is a database of another program"));
        }
        // The version has a copy in a row: a flipped bit changes one of both.
        let noted = noted_version(&transaction);
        if (version, noted) == (known, Some(known)) {
            return Ok(None);
        }
        if version > known && noted != Some(known) {
            return Ok(Some(version));
        }
        let done = usize::try_from(if noted == Some(known) { known } else { version }).unwrap_or(usize::MAX);
        let Some(todo) = migrations.get(done..) else { return Err(damaged("its version is none")) };
        transaction.execute_batch(
            "CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value ANY NOT NULL) WITHOUT ROWID, STRICT",
        )?;
        for statements in todo {
            transaction.execute_batch(statements)?;
        }
        transaction.execute("INSERT OR REPLACE INTO meta VALUES ('schema', ?1)", [known])?;
        transaction.pragma_update(None, "application_id", application)?;
        transaction.pragma_update(None, "user_version", known)?;
        transaction.commit().map(|()| None)
    }

    /// Renames a damaged database, in the same folder.
    fn move_aside(&mut self) -> Result<PathBuf, DatabaseError> {
        if let Place::Simulated(disk) = &self.place {
            (disk.set_aside)();
            return Ok(self.path.clone());
        }
        let aside = (1..ASIDE_MAX).map(|number| self.aside(number)).find(|aside| !aside.exists());
        let aside = aside.unwrap_or_else(|| self.aside(ASIDE_MAX));
        let mut renamed = Vec::new();
        // SQLite would read the log of another database.
        for suffix in ["-wal", "-shm", ""] {
            let (from, to) = (with_suffix(&self.path, suffix), with_suffix(&aside, suffix));
            match fs::rename(&from, &to) {
                Ok(()) => renamed.push((from, to)),
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => {
                    renamed.into_iter().for_each(|(from, to)| _ = fs::rename(to, from));
                    return Err(failed(&from, "set aside")(error));
                }
            }
        }
        self.place = Place::File(lock(&self.path)?);
        Ok(aside)
    }

    fn aside(&self, number: usize) -> PathBuf {
        with_suffix(&self.path, &format!(".damaged-{number}"))
    }

    /// The databases that were set aside.
    pub fn set_aside(&self) -> impl Iterator<Item = PathBuf> {
        (1..=ASIDE_MAX).map(|number| self.aside(number)).filter(|aside| aside.exists())
    }

    /// Whether this process may write its files.
    fn is_writable(&self) -> bool {
        let may_write = |suffix: &str| {
            let opened = OpenOptions::new().append(true).open(with_suffix(&self.path, suffix));
            opened.map_or_else(|error| error.kind() == io::ErrorKind::NotFound, |_| true)
        };
        matches!(self.place, Place::Simulated(_)) || ["", "-wal", "-shm"].into_iter().all(may_write)
    }

    /// Removes the databases that were set aside.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn remove_set_aside(&self) -> io::Result<()> {
        for number in 1..=ASIDE_MAX {
            for suffix in ["", "-wal", "-shm"] {
                match fs::remove_file(with_suffix(&self.aside(number), suffix)) {
                    Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The connection.
    ///
    /// # Errors
    /// When the last attempt to open it failed.
    pub fn connection(&self) -> rusqlite::Result<&Connection> {
        self.connection.as_ref().ok_or(rusqlite::Error::InvalidQuery)
    }

    /// Runs work in one transaction: all of it takes effect or none.
    ///
    /// # Errors
    /// Errors of the work and of SQLite, such as a full disk.
    pub fn write<T>(&mut self, work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>) -> rusqlite::Result<T> {
        let Some(connection) = &mut self.connection else { return Err(rusqlite::Error::InvalidQuery) };
        let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let done = work(&transaction)?;
        transaction.commit()?;
        Ok(done)
    }

    /// Runs work in one transaction, which is on the disk afterwards, with all commits before it. After a failure the system may treat lost pages as
    /// written: call [`Database::reopen`], and write them again.
    ///
    /// # Errors
    /// As [`Database::write`], and when the file was moved or removed.
    pub fn write_synced<T>(
        &mut self,
        work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
    ) -> rusqlite::Result<T> {
        if self.wal_bytes() > WAL_BYTES_MAX {
            self.checkpoint("PASSIVE")?;
        }
        // A commit in this mode syncs the log, and with it all commits before.
        self.connection()?.pragma_update(None, "synchronous", "full")?;
        let done = self.write(work);
        self.connection()?.pragma_update(None, "synchronous", "normal")?;
        let done = done?;
        self.require_name()?;
        Ok(done)
    }

    /// Copies the log into the file; gives whether another program has kept it from that.
    fn checkpoint(&self, mode: &str) -> rusqlite::Result<bool> {
        self.connection()?.query_row(&format!("PRAGMA wal_checkpoint({mode})"), [], |row| row.get(0))
    }

    /// Removes all deleted data from file and log.
    ///
    /// # Errors
    /// When the disk refuses, or another program reads the database for long.
    pub fn erase(&mut self) -> rusqlite::Result<()> {
        self.connection()?.execute_batch("VACUUM")?;
        if self.checkpoint("TRUNCATE")? {
            return Err(sqlite_error(rusqlite::ffi::SQLITE_BUSY, "another program reads the database"));
        }
        self.require_name()
    }

    /// Copies the log into the file, so that the next commits reuse its space: a full disk may have no other space.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn make_room(&self) -> rusqlite::Result<()> {
        self.checkpoint("PASSIVE").map(|_| ())
    }

    fn wal_bytes(&self) -> u64 {
        match self.place {
            Place::File(_) => fs::metadata(with_suffix(&self.path, "-wal")).map_or(0, |about| about.len()),
            // Always above the limit, so that tests copy often.
            Place::Simulated(_) => WAL_BYTES_MAX + 1,
        }
    }

    /// Bytes of file and log.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        fs::metadata(&self.path).map_or(0, |about| about.len()) + self.wal_bytes()
    }

    /// Fails if the file was removed or moved, or its disk is gone: the next process would not find it.
    fn require_name(&self) -> rusqlite::Result<()> {
        let Place::File(file) = &self.place else { return Ok(()) };
        let ours = file.metadata();
        let there = fs::metadata(&self.path);
        let is_same =
            |(ours, there): (fs::Metadata, fs::Metadata)| (ours.dev(), ours.ino()) == (there.dev(), there.ino());
        if ours.ok().zip(there.ok()).is_some_and(is_same) {
            return Ok(());
        }
        let reason = "the file was removed, or its disk is gone, so the next start will not find what was written; restart the process, which makes a new one";
        Err(sqlite_error(rusqlite::ffi::SQLITE_IOERR, reason))
    }
}

/// Opens a database for reading, also while its process writes to it.
///
/// # Errors
/// When there is none, or it cannot be read.
pub fn look(path: &Path) -> rusqlite::Result<Connection> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags)?;
    connection.busy_timeout(Duration::from_secs(5))?;
    Ok(connection)
}

/// Copies the rows of a table into the table of the same name, until one cannot be read.
///
/// # Errors
/// When a row cannot be read or written.
fn copy(from: &Connection, to: &Transaction<'_>, table: &str, order: &str, copied: &mut usize) -> rusqlite::Result<()> {
    let mut query = from.prepare(&format!("SELECT * FROM {table} ORDER BY 1 {order}"))?;
    let columns = query.column_count();
    let marks = vec!["?"; columns].join(", ");
    let mut insert = to.prepare(&format!("INSERT OR IGNORE INTO {table} VALUES ({marks})"))?;
    let (mut rows, mut all) = (query.query([])?, Ok(()));
    while let Some(row) = rows.next()? {
        let values = (0..columns).map(|at| row.get::<_, Value>(at)).collect::<rusqlite::Result<Vec<_>>>();
        match values.and_then(|values| insert.execute(params_from_iter(values))) {
            Ok(rows) => *copied += rows,
            Err(error) => all = Err(error),
        }
    }
    all
}

/// The work of a transaction that only syncs: one without a change writes nothing.
///
/// # Errors
/// When the disk refuses.
pub fn count_sync(transaction: &Transaction<'_>) -> rusqlite::Result<()> {
    let count = "INSERT INTO meta VALUES ('syncs', 1) ON CONFLICT (key) DO UPDATE SET value = value + 1";
    transaction.prepare_cached(count)?.execute([]).map(|_| ())
}

/// The program of a database, and the version of its schema.
fn version(connection: &Connection) -> rusqlite::Result<(i32, i64)> {
    let application = connection.pragma_query_value(None, "application_id", |row| row.get(0))?;
    Ok((application, connection.pragma_query_value(None, "user_version", |row| row.get(0))?))
}

/// The copy of the version; `None` if the database has none that can be read.
fn noted_version(connection: &Connection) -> Option<i64> {
    connection.query_row("SELECT value FROM meta WHERE key = 'schema'", [], |row| row.get(0)).ok()
}

/// The content of a row; `None` if a column has a value that no sound row has.
///
/// # Errors
/// Any other error.
pub fn sound<T>(row: rusqlite::Result<T>) -> rusqlite::Result<Option<T>> {
    match row {
        Err(error) if is_value(&error) => Ok(None),
        row => row.map(Some),
    }
}

/// Whether a column has a value that no sound row has.
fn is_value(error: &rusqlite::Error) -> bool {
    use rusqlite::Error::{FromSqlConversionFailure, IntegralValueOutOfRange, InvalidColumnType, Utf8Error};
    matches!(error, FromSqlConversionFailure(..) | IntegralValueOutOfRange(..) | InvalidColumnType(..) | Utf8Error(..))
}

/// Whether an error means a damaged file, and not a problem of the disk or another process.
#[must_use]
pub fn is_damage(error: &rusqlite::Error) -> bool {
    use rusqlite::Error::{InvalidColumnIndex, QueryReturnedNoRows, SqlInputError};
    let Some(failure) = error.sqlite_error() else {
        // A damaged schema has other columns.
        return is_value(error) || matches!(error, InvalidColumnIndex(..) | QueryReturnedNoRows | SqlInputError { .. });
    };
    failure.extended_code == rusqlite::ffi::SQLITE_IOERR_SHORT_READ
        || !matches!(
            failure.code,
            ErrorCode::CannotOpen
                | ErrorCode::DatabaseBusy
                | ErrorCode::DatabaseLocked
                | ErrorCode::DiskFull
                | ErrorCode::FileLockingProtocolFailed
                | ErrorCode::OutOfMemory
                | ErrorCode::PermissionDenied
                | ErrorCode::ReadOnly
                | ErrorCode::SystemIoFailure
        )
}

/// The message of an error, with SQLite's own one if that says more.
fn reason(error: &rusqlite::Error) -> String {
    match error {
        rusqlite::Error::SqliteFailure(code, Some(text)) if !code.to_string().ends_with(text.as_str()) => {
            format!("{text} ({code})")
        }
        error => error.to_string(),
    }
}

fn damaged(reason: &str) -> rusqlite::Error {
    sqlite_error(rusqlite::ffi::SQLITE_CORRUPT, reason)
}

fn sqlite_error(code: i32, reason: &str) -> rusqlite::Error {
    rusqlite::Error::SqliteFailure(rusqlite::ffi::Error::new(code), Some(reason.to_owned()))
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

fn failed(path: &Path, operation: &'static str) -> impl FnOnce(io::Error) -> DatabaseError {
    let path = path.to_owned();
    move |source| DatabaseError::File(path, operation, source)
}

/// Opens the file, or makes one that its owner alone may read.
fn own_file(path: &Path) -> io::Result<File> {
    let no_link = rustix::fs::OFlags::NOFOLLOW.bits().cast_signed();
    OpenOptions::new().read(true).append(true).create(true).mode(0o600).custom_flags(no_link).open(path)
}

/// Makes the file if it is missing, and locks it for this process. Its owner alone may read it.
fn lock(path: &Path) -> Result<File, DatabaseError> {
    for suffix in ["", "-wal", "-shm"] {
        let path = with_suffix(path, suffix);
        require_own(&path).map_err(|source| DatabaseError::Refused(path.clone(), source))?;
        // Others could read a copy, as a backup makes one. A process that does not own the file cannot change that.
        if fs::metadata(&path).is_ok_and(|found| found.permissions().mode() & 0o077 != 0) {
            let _kept = fs::set_permissions(&path, fs::Permissions::from_mode(0o600));
        }
    }
    let file = own_file(path).map_err(failed(path, "open"))?;
    let start = Instant::now();
    while let Err(error) = rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
        if error != rustix::io::Errno::WOULDBLOCK {
            return Err(failed(path, "lock")(error.into()));
        }
        if start.elapsed() >= LOCKED_FOR {
            return Err(DatabaseError::Locked(path.to_owned()));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(file)
}
