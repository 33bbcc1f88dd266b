//! A simulated disk, as a VFS of SQLite, with the contents that readers see and the contents that survive a power loss. A call may fail, a failed
//! sync may lose data, a read may return an old or a wrong block, and a power loss takes some unsynced data.

#![allow(unsafe_code, reason = "SQLite asks for its files through C")]

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{CStr, c_char, c_int, c_void};
use std::ptr::null_mut;
use std::sync::Once;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_database::Simulation;
use roomcast_database::rusqlite::ffi;

/// Bytes that are written or read together.
const BLOCK: usize = 512;
/// The files, the database first.
const FILES: [&str; 4] = ["simulated", "simulated-wal", "simulated-journal", "temporary"];
const DATABASE: &str = FILES[0];
const NAME: &CStr = c"roomcast-simulated";

counts! { DiskTally: failed_calls, failed_syncs, stale_reads, misdirected_reads, set_aside; also: }

/// One file.
#[derive(Debug, Default, Clone)]
struct File {
    /// The bytes for a reader.
    shown: Vec<u8>,
    /// The bytes after a power loss.
    kept: Vec<u8>,
    /// The bytes of the disk before that, for a stale read.
    before: Vec<u8>,
    /// Blocks that are not on the disk yet.
    dirty: BTreeSet<usize>,
}

impl File {
    fn overwrite(&mut self, at: usize, bytes: &[u8]) {
        let end = at + bytes.len();
        if self.shown.len() < end {
            self.shown.resize(end, 0);
        }
        self.shown[at..end].copy_from_slice(bytes);
        self.dirty.extend(at / BLOCK..end.div_ceil(BLOCK));
    }

    fn keep(&mut self, block: usize) {
        let range = block * BLOCK..((block + 1) * BLOCK).min(self.shown.len());
        let Some(bytes) = self.shown.get(range.clone()) else { return };
        if self.kept.len() < range.end {
            self.kept.resize(range.end, 0);
        }
        self.kept[range].copy_from_slice(bytes);
    }
}

#[derive(Debug)]
struct Machine {
    rng: ChaCha8Rng,
    /// A failed sync counts as successful: a planted fault.
    hides_failed_syncs: bool,
    files: BTreeMap<&'static str, File>,
    /// No file can grow.
    is_full: bool,
    /// Probabilities that a call fails, and that a start reads a wrong block.
    fails: f64,
    misreads: f64,
    /// A wrong block of the database, which every read returns until the next start.
    misreading: Option<(usize, Vec<u8>)>,
    tally: DiskTally,
}

thread_local! {
    /// The disk of this thread's world.
    static MACHINE: RefCell<Option<Machine>> = const { RefCell::new(None) };
}

fn with<T>(work: impl FnOnce(&mut Machine) -> T) -> T {
    MACHINE.with_borrow_mut(|machine| work(machine.as_mut().expect("a disk was made on this thread")))
}

impl Machine {
    fn fails(&mut self) -> bool {
        let fails = self.rng.random_bool(self.fails);
        self.tally.failed_calls += u64::from(fails);
        fails
    }

    /// A start may read a wrong block or an old one.
    fn misread(&mut self) {
        let file = self.files.get(DATABASE).cloned().unwrap_or_default();
        let blocks = file.shown.len() / BLOCK;
        if blocks == 0 || !self.rng.random_bool(self.misreads) {
            return;
        }
        let block = self.rng.random_range(0..blocks);
        let range = block * BLOCK..(block + 1) * BLOCK;
        let is_stale = self.rng.random_bool(0.5);
        let given = if is_stale {
            // Before the first write the disk has zeros.
            let mut before = file.before;
            before.resize(before.len().max(range.end), 0);
            before[range.clone()].to_vec()
        } else {
            let from = self.rng.random_range(0..blocks);
            file.shown[from * BLOCK..(from + 1) * BLOCK].to_vec()
        };
        if file.shown[range] != given {
            *(if is_stale { &mut self.tally.stale_reads } else { &mut self.tally.misdirected_reads }) += 1;
            self.misreading = Some((block, given));
        }
    }
}

/// Access to this thread's disk.
#[derive(Debug, Clone, Copy)]
pub struct SimulatedDisk;

impl SimulatedDisk {
    /// Replaces the thread's disk by an empty one.
    pub fn new(seed: u64, hides_failed_syncs: bool) -> Self {
        static REGISTERED: Once = Once::new();
        REGISTERED.call_once(register);
        let machine = Machine {
            rng: ChaCha8Rng::seed_from_u64(seed),
            hides_failed_syncs,
            files: BTreeMap::new(),
            is_full: false,
            fails: 0.0,
            misreads: 0.0,
            misreading: None,
            tally: DiskTally::default(),
        };
        MACHINE.set(Some(machine));
        Self
    }

    /// The disk as the product's argument.
    pub fn simulation(self) -> Simulation {
        let set_aside = || {
            with(|machine| {
                machine.files.clear();
                machine.tally.set_aside += 1;
            });
        };
        Simulation { vfs: NAME.to_str().unwrap(), set_aside }
    }

    /// Sets the probabilities that a call fails and that a start reads a wrong block.
    pub fn set_faults(self, fails: f64, misreads: f64) {
        with(|machine| (machine.fails, machine.misreads) = (fails, misreads));
    }

    /// From now on no file can grow.
    pub fn fill(self) {
        with(|machine| machine.is_full = true);
    }

    pub fn tally(self) -> DiskTally {
        with(|machine| machine.tally)
    }

    /// The last start has read a wrong block.
    pub fn was_misread(self) -> bool {
        with(|machine| machine.misreading.is_some())
    }

    /// A daemon starts.
    pub fn start(self) {
        with(|machine| {
            machine.misreading = None;
            machine.misread();
        });
    }

    /// Flips a bit of a file and drops its old bytes. Returns false if all files are empty.
    pub fn damage(self) -> bool {
        with(|machine| {
            let Machine { rng, files, .. } = machine;
            let mut files: Vec<&mut File> = files.values_mut().filter(|file| !file.shown.is_empty()).collect();
            if files.is_empty() {
                return false;
            }
            let which = rng.random_range(0..files.len());
            let file = &mut files[which];
            let at = rng.random_range(0..file.shown.len());
            file.shown[at] ^= 1 << rng.random_range(0..8);
            (file.kept, file.before) = (file.shown.clone(), file.shown.clone());
            true
        })
    }

    /// The power fails: each file loses some of its unsynced data.
    pub fn lose_power(self) {
        with(|machine| {
            let Machine { rng, files, .. } = machine;
            for file in files.values_mut() {
                for block in std::mem::take(&mut file.dirty) {
                    if rng.random_bool(0.5) {
                        file.keep(block);
                    }
                }
                // The length may have reached the disk without the content.
                if file.kept.len() != file.shown.len() && rng.random_bool(0.3) {
                    file.kept.resize(file.shown.len(), 0);
                }
                (file.shown, file.before) = (file.kept.clone(), file.kept.clone());
            }
        });
    }
}

/// A file that SQLite has open.
#[repr(C)]
struct Open {
    base: ffi::sqlite3_file,
    name: &'static str,
}

/// Runs work on an open file, with its name and whether the call fails.
fn of_file(file: *mut ffi::sqlite3_file, work: impl FnOnce(&mut Machine, &str, &mut File, bool) -> c_int) -> c_int {
    // SAFETY: SQLite gives a file that `open` has opened.
    let name = unsafe { (*file.cast::<Open>()).name };
    with(|machine| {
        let (fails, mut file) = (machine.fails(), machine.files.remove(name).unwrap_or_default());
        let code = work(machine, name, &mut file, fails);
        machine.files.insert(name, file);
        code
    })
}

unsafe extern "C" fn close(_file: *mut ffi::sqlite3_file) -> c_int {
    ffi::SQLITE_OK
}

unsafe extern "C" fn read(file: *mut ffi::sqlite3_file, to: *mut c_void, count: c_int, at: i64) -> c_int {
    let (count, at) = (usize::try_from(count).unwrap(), usize::try_from(at).unwrap());
    // SAFETY: SQLite gives room for that many bytes.
    let to = unsafe { std::slice::from_raw_parts_mut(to.cast::<u8>(), count) };
    of_file(file, |machine, name, file, fails| {
        if fails {
            return ffi::SQLITE_IOERR_READ;
        }
        let found = file.shown.get(at..).unwrap_or_default();
        let found = &found[..found.len().min(count)];
        to.fill(0);
        to[..found.len()].copy_from_slice(found);
        if let Some((block, given)) = machine.misreading.as_ref().filter(|_| name == DATABASE)
            && (block + 1) * BLOCK <= file.shown.len()
        {
            let wrong = (block * BLOCK..).zip(given).filter(|(place, _)| (at..at + count).contains(place));
            wrong.for_each(|(place, byte)| to[place - at] = *byte);
        }
        if found.len() == count { ffi::SQLITE_OK } else { ffi::SQLITE_IOERR_SHORT_READ }
    })
}

unsafe extern "C" fn write(file: *mut ffi::sqlite3_file, from: *const c_void, count: c_int, at: i64) -> c_int {
    // SAFETY: SQLite gives that many bytes.
    let from = unsafe { std::slice::from_raw_parts(from.cast::<u8>(), usize::try_from(count).unwrap()) };
    let at = usize::try_from(at).unwrap();
    of_file(file, |machine, _, file, fails| {
        let written = if fails { machine.rng.random_range(0..=from.len()) } else { from.len() };
        if machine.is_full && at + from.len() > file.shown.len() {
            return ffi::SQLITE_FULL;
        }
        file.overwrite(at, &from[..written]);
        if fails { ffi::SQLITE_FULL } else { ffi::SQLITE_OK }
    })
}

unsafe extern "C" fn truncate(file: *mut ffi::sqlite3_file, length: i64) -> c_int {
    of_file(file, |_, _, file, fails| {
        if fails {
            return ffi::SQLITE_IOERR_TRUNCATE;
        }
        let length = usize::try_from(length).unwrap();
        file.shown.resize(length, 0);
        file.dirty.retain(|block| *block <= length / BLOCK);
        file.dirty.insert(length / BLOCK);
        ffi::SQLITE_OK
    })
}

unsafe extern "C" fn sync(file: *mut ffi::sqlite3_file, _flags: c_int) -> c_int {
    of_file(file, |machine, _, file, fails| {
        file.before.clone_from(&file.kept);
        for block in std::mem::take(&mut file.dirty) {
            if !fails || machine.rng.random_bool(0.5) {
                file.keep(block);
                continue;
            }
            // The system marks the page as written, and may return the disk's content from now on.
            if machine.rng.random_bool(0.5) {
                let range = block * BLOCK..((block + 1) * BLOCK).min(file.shown.len());
                let mut kept = file.kept.clone();
                kept.resize(kept.len().max(range.end), 0);
                if let Some(shown) = file.shown.get_mut(range.clone()) {
                    shown.copy_from_slice(&kept[range]);
                }
            }
        }
        if !fails {
            file.kept.resize(file.shown.len(), 0);
            return ffi::SQLITE_OK;
        }
        machine.tally.failed_syncs += 1;
        if machine.hides_failed_syncs { ffi::SQLITE_OK } else { ffi::SQLITE_IOERR_FSYNC }
    })
}

unsafe extern "C" fn size(file: *mut ffi::sqlite3_file, out: *mut i64) -> c_int {
    of_file(file, |_, _, file, fails| {
        // SAFETY: SQLite gives room for the answer.
        unsafe { *out = i64::try_from(file.shown.len()).unwrap() };
        if fails { ffi::SQLITE_IOERR_FSTAT } else { ffi::SQLITE_OK }
    })
}

unsafe extern "C" fn lock(_file: *mut ffi::sqlite3_file, _level: c_int) -> c_int {
    ffi::SQLITE_OK
}

unsafe extern "C" fn is_reserved(_file: *mut ffi::sqlite3_file, out: *mut c_int) -> c_int {
    // SAFETY: SQLite gives room for the answer.
    unsafe { *out = 0 };
    ffi::SQLITE_OK
}

unsafe extern "C" fn control(_file: *mut ffi::sqlite3_file, _what: c_int, _argument: *mut c_void) -> c_int {
    ffi::SQLITE_NOTFOUND
}

unsafe extern "C" fn sector_bytes(_file: *mut ffi::sqlite3_file) -> c_int {
    BLOCK as c_int
}

unsafe extern "C" fn features(_file: *mut ffi::sqlite3_file) -> c_int {
    0
}

static METHODS: ffi::sqlite3_io_methods = ffi::sqlite3_io_methods {
    iVersion: 1,
    xClose: Some(close),
    xRead: Some(read),
    xWrite: Some(write),
    xTruncate: Some(truncate),
    xSync: Some(sync),
    xFileSize: Some(size),
    xLock: Some(lock),
    xUnlock: Some(lock),
    xCheckReservedLock: Some(is_reserved),
    xFileControl: Some(control),
    xSectorSize: Some(sector_bytes),
    xDeviceCharacteristics: Some(features),
    xShmMap: None,
    xShmLock: None,
    xShmBarrier: None,
    xShmUnmap: None,
    xFetch: None,
    xUnfetch: None,
};

/// The file of a path.
///
/// # Safety
/// `path` ends with a zero byte, or is null for a temporary file.
unsafe fn name_of(path: *const c_char) -> &'static str {
    if path.is_null() {
        return "temporary";
    }
    // SAFETY: the caller promises it.
    let path = unsafe { CStr::from_ptr(path) }.to_str().unwrap();
    FILES.into_iter().find(|name| path.ends_with(&format!("/{name}"))).unwrap()
}

unsafe extern "C" fn open(
    _vfs: *mut ffi::sqlite3_vfs,
    name: ffi::sqlite3_filename,
    file: *mut ffi::sqlite3_file,
    flags: c_int,
    out: *mut c_int,
) -> c_int {
    // SAFETY: SQLite gives a path, or null for a temporary file.
    let name = unsafe { name_of(name) };
    // SAFETY: SQLite gives room for a file of `szOsFile` bytes.
    let file = unsafe { &mut *file.cast::<Open>() };
    file.base.pMethods = std::ptr::null();
    if with(Machine::fails) {
        return ffi::SQLITE_IOERR;
    }
    with(|machine| _ = machine.files.entry(name).or_default());
    (file.base.pMethods, file.name) = (&METHODS, name);
    if !out.is_null() {
        // SAFETY: SQLite gives room for the answer, or null.
        unsafe { *out = flags };
    }
    ffi::SQLITE_OK
}

unsafe extern "C" fn delete(_vfs: *mut ffi::sqlite3_vfs, name: *const c_char, _sync: c_int) -> c_int {
    // SAFETY: SQLite gives a path.
    let name = unsafe { name_of(name) };
    with(|machine| {
        if machine.fails() {
            return ffi::SQLITE_IOERR_DELETE;
        }
        machine.files.remove(name);
        ffi::SQLITE_OK
    })
}

unsafe extern "C" fn access(_vfs: *mut ffi::sqlite3_vfs, name: *const c_char, _flags: c_int, out: *mut c_int) -> c_int {
    // SAFETY: SQLite gives a path, and room for the answer.
    unsafe { *out = c_int::from(with(|machine| machine.files.contains_key(name_of(name)))) };
    ffi::SQLITE_OK
}

/// Registers the disk with SQLite, once in a process. Clock, sleep and full paths are those of the default VFS.
fn register() {
    // SAFETY: SQLite has a default VFS, which is never freed.
    let default = unsafe { *ffi::sqlite3_vfs_find(std::ptr::null()) };
    let vfs = Box::leak(Box::new(ffi::sqlite3_vfs {
        szOsFile: size_of::<Open>() as c_int,
        pNext: null_mut(),
        zName: NAME.as_ptr(),
        xOpen: Some(open),
        xDelete: Some(delete),
        xAccess: Some(access),
        ..default
    }));
    // SAFETY: the VFS is complete, and is never freed.
    let code = unsafe { ffi::sqlite3_vfs_register(vfs, 0) };
    assert_eq!(code, ffi::SQLITE_OK);
}
