//! A disk of the simulation: two files and their names, as the system shows them and as the disk has them. A call may fail, a sync may lose what
//! it fails with, a read may give a block of elsewhere or of before, and power that fails takes some of what no sync has reached.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::io;
use std::rc::Rc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_core::narration::Observation;
use roomcast_services::daemon::journal::{Disk, Half};
use roomcast_services::daemon::{Recovered, journal};

/// Bytes that reach the disk, or are read from it, together.
const BLOCK: usize = 512;

/// A fault planted into the disk, or into what the journal asks of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiskFault {
    /// Names are not brought to the disk, and count as brought.
    NamesNotSynced,
    /// A sync that fails counts as one that went well.
    SyncErrorsHidden,
    /// At a rotation the full half goes, not the one before it.
    FullHalfGoes,
    /// A new half begins without anybody's last words.
    WordsNotCarried,
    /// A new half begins without whose the sources are.
    PortsNotCarried,
    /// What was read is taken for what is there, and written over it.
    ReadsWrittenBack,
}

/// What happened to the disk.
#[derive(Debug, Default, Clone, Copy)]
pub struct DiskTally {
    pub rotations: u64,
    pub failed_calls: u64,
    pub failed_syncs: u64,
    pub stale_reads: u64,
    pub misdirected_reads: u64,
    pub names_lost: u64,
}

/// One file.
#[derive(Debug, Default, Clone)]
struct File {
    /// What whoever reads it is given.
    shown: Vec<u8>,
    /// What a loss of power leaves.
    kept: Vec<u8>,
    /// What the disk had before that, which a stale read gives.
    before: Vec<u8>,
    /// Blocks that the system has still to bring to the disk.
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

    /// Brings one block to the disk.
    fn keep(&mut self, block: usize) {
        let range = block * BLOCK..((block + 1) * BLOCK).min(self.shown.len());
        let Some(bytes) = self.shown.get(range.clone()) else { return };
        if self.kept.len() < range.end {
            self.kept.resize(range.end, 0);
        }
        self.kept[range].copy_from_slice(bytes);
    }
}

/// Which file has which name.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
struct Names {
    older: Option<usize>,
    current: Option<usize>,
    next: Option<usize>,
}

#[derive(Debug)]
struct Machine {
    rng: ChaCha8Rng,
    planted: Option<DiskFault>,
    files: Vec<File>,
    names: Names,
    /// The names that the disk has, and after them what was done to them since, in order.
    kept_names: Vec<Names>,
    open: usize,
    prepared: Option<usize>,
    /// How likely each call fails, and each read at a start is wrong.
    fails: f64,
    misreads: f64,
    /// Pages were lost that nobody has written again yet.
    lacks_pages: bool,
    /// A block of a file, until the next start, as every read gives it: what the disk does not have there.
    misreading: Option<(usize, usize, Vec<u8>)>,
    tally: DiskTally,
}

/// The way to the disk, for a daemon and for whoever takes its power.
#[derive(Debug, Clone)]
pub struct SimulatedDisk(Rc<RefCell<Machine>>);

fn refused() -> io::Error {
    io::ErrorKind::StorageFull.into()
}

impl Machine {
    fn fails(&mut self) -> bool {
        let fails = self.rng.random_bool(self.fails);
        self.tally.failed_calls += u64::from(fails);
        fails
    }

    fn file(&self, half: Half) -> Option<&File> {
        let name = match half {
            Half::Older => self.names.older,
            Half::Current => self.names.current,
        };
        name.map(|file| &self.files[file])
    }

    /// Notes that a name has changed.
    fn renamed(&mut self) {
        self.kept_names.push(self.names);
    }

    /// A block of what a start reads may be of elsewhere, or of before.
    fn misread(&mut self) {
        if !self.rng.random_bool(self.misreads) {
            return;
        }
        let named: Vec<usize> = [self.names.older, self.names.current].into_iter().flatten().collect();
        let blocks: Vec<_> = named
            .iter()
            .flat_map(|file| (0..self.files[*file].shown.len() / BLOCK).map(move |block| (*file, block)))
            .collect();
        if blocks.is_empty() {
            return;
        }
        let (file, block) = blocks[self.rng.random_range(0..blocks.len())];
        let range = block * BLOCK..(block + 1) * BLOCK;
        let is_stale = self.rng.random_bool(0.5);
        let given = if is_stale {
            // Of before it was written the disk has zeros.
            let mut before = self.files[file].before.clone();
            before.resize(before.len().max(range.end), 0);
            before[range.clone()].to_vec()
        } else {
            let (other, from) = blocks[self.rng.random_range(0..blocks.len())];
            self.files[other].shown[from * BLOCK..(from + 1) * BLOCK].to_vec()
        };
        if self.files[file].shown[range.clone()] == given {
            return;
        }
        *(if is_stale { &mut self.tally.stale_reads } else { &mut self.tally.misdirected_reads }) += 1;
        self.misreading = Some((file, block, given));
    }
}

impl SimulatedDisk {
    /// An empty disk.
    pub fn new(seed: u64, planted: Option<DiskFault>) -> Self {
        Self(Rc::new(RefCell::new(Machine {
            rng: ChaCha8Rng::seed_from_u64(seed),
            planted,
            files: Vec::new(),
            names: Names::default(),
            kept_names: vec![Names::default()],
            open: 0,
            prepared: None,
            fails: 0.0,
            misreads: 0.0,
            lacks_pages: false,
            misreading: None,
            tally: DiskTally::default(),
        })))
    }

    /// From now on calls fail, and reads at a start are wrong, with these probabilities.
    pub fn set_faults(&self, fails: f64, misreads: f64) {
        let mut machine = self.0.borrow_mut();
        (machine.fails, machine.misreads) = (fails, misreads);
    }

    pub fn tally(&self) -> DiskTally {
        self.0.borrow().tally
    }

    /// Bytes in both halves.
    pub fn bytes(&self) -> usize {
        let machine = self.0.borrow();
        [Half::Older, Half::Current].iter().filter_map(|half| machine.file(*half)).map(|file| file.shown.len()).sum()
    }

    /// Pages of the open file were lost with a sync that failed, and are not written again.
    pub fn lacks_pages(&self) -> bool {
        self.0.borrow().lacks_pages
    }

    /// The last start was given what the disk does not have.
    pub fn was_misread(&self) -> bool {
        self.0.borrow().misreading.is_some()
    }

    /// Does what a starting daemon does with the folder: a next file takes the place of a current one that is missing, or goes.
    pub fn start(&self) -> io::Result<()> {
        let mut machine = self.0.borrow_mut();
        machine.misreading = None;
        if machine.names.current.is_none() {
            if machine.names.next.is_none() {
                machine.files.push(File::default());
                machine.names.next = Some(machine.files.len() - 1);
            }
            machine.names.current = machine.names.next;
        }
        machine.names.next = None;
        machine.prepared = None;
        machine.renamed();
        machine.open = machine.names.current.unwrap_or_default();
        if machine.fails() {
            return Err(refused());
        }
        machine.kept_names = vec![machine.names];
        machine.misread();
        Ok(())
    }

    /// What a reader takes from both halves that reads every record by itself.
    pub fn read_record_by_record(&self, boot_id: &[u8; 16]) -> Vec<Observation> {
        let mut observations = Vec::new();
        for half in [Half::Older, Half::Current] {
            let bytes = Disk::read(self, half).unwrap_or_default();
            let begins = bytes.windows(3).enumerate().filter(|(_, letters)| *letters == b"RCJ").map(|(at, _)| at);
            let mut begins: Vec<_> = begins.collect();
            begins.push(bytes.len());
            for record in begins.windows(2) {
                let mut recovered = Recovered::default();
                journal::read_records(&bytes[record[0]..record[1]], boot_id, &mut recovered);
                observations.append(&mut recovered.observations);
            }
        }
        observations
    }

    /// What a killed daemon has written of a record.
    pub fn tear(&self, bytes: &[u8]) {
        let machine = &mut *self.0.borrow_mut();
        let file = &mut machine.files[machine.open];
        file.overwrite(file.shown.len(), bytes);
    }

    /// Changes a file of those that have a name, or says that there is nothing in them. What it was before is gone.
    pub fn damage(&self, mut damage: impl FnMut(&mut Vec<u8>)) -> bool {
        let machine = &mut *self.0.borrow_mut();
        let mut named: Vec<usize> = [machine.names.older, machine.names.current].into_iter().flatten().collect();
        named.retain(|file| !machine.files[*file].shown.is_empty());
        if named.is_empty() {
            return false;
        }
        let file = &mut machine.files[named[machine.rng.random_range(0..named.len())]];
        damage(&mut file.shown);
        (file.kept, file.before) = (file.shown.clone(), file.shown.clone());
        true
    }

    /// The power fails: of names some of the last changes are gone, and of each file some of what no sync has reached.
    pub fn lose_power(&self) {
        let machine = &mut *self.0.borrow_mut();
        let reached = machine.rng.random_range(0..machine.kept_names.len());
        machine.tally.names_lost += u64::from(machine.kept_names[reached] != machine.names);
        machine.names = machine.kept_names[reached];
        machine.kept_names = vec![machine.names];
        (machine.prepared, machine.lacks_pages) = (None, false);
        for file in &mut machine.files {
            for block in std::mem::take(&mut file.dirty) {
                if machine.rng.random_bool(0.5) {
                    file.keep(block);
                }
            }
            // How long it is may have reached the disk without what is in it.
            if file.kept.len() != file.shown.len() && machine.rng.random_bool(0.3) {
                file.kept.resize(file.shown.len(), 0);
            }
            (file.shown, file.before) = (file.kept.clone(), file.kept.clone());
        }
    }
}

impl Disk for SimulatedDisk {
    fn read(&self, half: Half) -> io::Result<Vec<u8>> {
        let machine = &mut *self.0.borrow_mut();
        if machine.fails() {
            return Err(refused());
        }
        let mut bytes = machine.file(half).map(|file| file.shown.clone()).unwrap_or_default();
        let is_misread = |name: Option<usize>| machine.misreading.as_ref().filter(|(file, ..)| Some(*file) == name);
        let name = if half == Half::Older { machine.names.older } else { machine.names.current };
        if let Some((_, block, given)) = is_misread(name) {
            bytes[block * BLOCK..(block + 1) * BLOCK].copy_from_slice(given);
        }
        if machine.planted == Some(DiskFault::ReadsWrittenBack)
            && let Some(file) = name
        {
            machine.files[file].overwrite(0, &bytes);
        }
        Ok(bytes)
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        let fails = machine.fails();
        let written = if fails { machine.rng.random_range(0..=bytes.len()) } else { bytes.len() };
        let file = &mut machine.files[machine.open];
        file.overwrite(file.shown.len(), &bytes[..written]);
        if fails { Err(refused()) } else { Ok(()) }
    }

    fn cut(&mut self, length: u64) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        if machine.fails() {
            return Err(refused());
        }
        let file = &mut machine.files[machine.open];
        let length = usize::try_from(length).unwrap_or(usize::MAX);
        assert!(length <= file.shown.len(), "a file of {} bytes is cut off after {length}", file.shown.len());
        file.shown.truncate(length);
        file.dirty.retain(|block| *block <= length / BLOCK);
        file.dirty.insert(length / BLOCK);
        Ok(())
    }

    fn rewrite(&mut self, pieces: &[(u64, Vec<u8>)]) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        let fails = machine.fails();
        let bytes = pieces.iter().map(|(_, piece)| piece.len()).sum();
        let mut left = if fails { machine.rng.random_range(0..=bytes) } else { bytes };
        let file = &mut machine.files[machine.open];
        for (at, piece) in pieces {
            let written = piece.len().min(left);
            left -= written;
            file.overwrite(usize::try_from(*at).unwrap_or(usize::MAX), &piece[..written]);
        }
        if fails {
            return Err(refused());
        }
        machine.lacks_pages = false;
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        let fails = machine.fails();
        let Machine { rng, files, open, .. } = machine;
        let file = &mut files[*open];
        file.before.clone_from(&file.kept);
        for block in std::mem::take(&mut file.dirty) {
            if !fails || rng.random_bool(0.5) {
                file.keep(block);
                continue;
            }
            // The system takes the page for written, and may give what the disk has from now on.
            if rng.random_bool(0.5) {
                let range = block * BLOCK..((block + 1) * BLOCK).min(file.shown.len());
                let mut kept = file.kept.clone();
                kept.resize(kept.len().max(range.end), 0);
                file.shown[range.clone()].copy_from_slice(&kept[range]);
            }
        }
        if !fails {
            file.kept.resize(file.shown.len(), 0);
            return Ok(());
        }
        machine.tally.failed_syncs += 1;
        if machine.planted == Some(DiskFault::SyncErrorsHidden) {
            return Ok(());
        }
        machine.lacks_pages = true;
        Err(refused())
    }

    fn prepare(&mut self, bytes: &[u8]) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        (machine.prepared, machine.names.next) = (None, None);
        if machine.fails() {
            machine.renamed();
            return Err(refused());
        }
        let dropped = match machine.planted {
            Some(DiskFault::WordsNotCarried) => b"78".as_slice(),
            Some(DiskFault::PortsNotCarried) => b"6",
            _ => &[],
        };
        let bytes = without(bytes, dropped);
        machine.files.push(File { shown: bytes.clone(), kept: bytes.clone(), before: bytes, ..File::default() });
        machine.prepared = Some(machine.files.len() - 1);
        machine.names.next = machine.prepared;
        machine.renamed();
        Ok(())
    }

    /// No half is ever too large here.
    fn remove_aside(&mut self) -> io::Result<()> {
        if self.0.borrow_mut().fails() { Err(refused()) } else { Ok(()) }
    }

    fn is_current(&self) -> io::Result<bool> {
        let machine = &mut *self.0.borrow_mut();
        if machine.fails() { Err(refused()) } else { Ok(machine.names.current == Some(machine.open)) }
    }

    fn retire(&mut self) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        if machine.fails() {
            return Err(refused());
        }
        let full = machine.names.current.take();
        if machine.planted != Some(DiskFault::FullHalfGoes) {
            machine.names.older = full;
        }
        machine.renamed();
        machine.tally.rotations += 1;
        Ok(())
    }

    fn place(&mut self, half: Half) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        let Some(next) = machine.prepared.take() else { return Err(io::Error::other("no file is prepared")) };
        if machine.fails() {
            return Err(refused());
        }
        machine.names.next = None;
        match half {
            Half::Older => machine.names.older = Some(next),
            Half::Current => {
                machine.names.current = Some(next);
                machine.open = next;
                // What the file before lacked is in its other half now.
                machine.lacks_pages = false;
            }
        }
        machine.renamed();
        Ok(())
    }

    fn sync_names(&mut self) -> io::Result<()> {
        let machine = &mut *self.0.borrow_mut();
        if machine.fails() {
            return Err(refused());
        }
        if machine.planted != Some(DiskFault::NamesNotSynced) {
            machine.kept_names = vec![machine.names];
        }
        Ok(())
    }
}

/// Whole records, of which those whose fourth letter is one of these are none any more.
fn without(records: &[u8], dropped: &[u8]) -> Vec<u8> {
    let mut kept = records.to_vec();
    let mut at = 0;
    while let Some(length) = records.get(at + 4..at + 8).and_then(|length| length.first_chunk()) {
        if dropped.contains(&records[at + 3]) {
            kept[at] = 0;
        }
        at += 12 + u32::from_le_bytes(*length) as usize;
    }
    kept
}
