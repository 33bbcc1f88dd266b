//! Services without file descriptors, shared memory, disk or rights end with a clear error or continue. They never die by a signal, and they recover.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use roomcast_ipc::raw::StatusResponseV1;
use roomcast_services::daemon::journal;
use rustix::process::{Pid, Signal, geteuid, kill_process};

use crate::eventually::{eventually, waited};
use crate::skipped::skipped;
use crate::world::{Process, World};

const NOBODY: u32 = 65_534;

fn status(world: &World) -> StatusResponseV1 {
    world.status(&world.domain.open("test").unwrap())
}

fn may_mount() -> bool {
    let may = Command::new("unshare").args(["-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]).output();
    let may = may.is_ok_and(|output| output.status.success());
    if !may {
        skipped("only root can mount the small file systems that this needs");
    }
    may
}

/// The log is a full pipe without a reader.
#[test]
#[ignore = "full"]
fn a_log_that_nobody_reads_holds_up_nothing() {
    let mut world = World::new("mute");
    let (unread, log) = rustix::pipe::pipe().unwrap();
    let room = rustix::pipe::fcntl_setpipe_size(&log, 4096).unwrap();
    // At level trace, the model's loading alone logs more than the pipe holds.
    let mut command = world.command(&["daemon"]);
    command.env("ROOMCAST_LOG", "trace").stdout(Stdio::null()).stderr(log);
    fs::write(world.path("log"), "(not read)").unwrap();
    world.children.push(Process { child: command.spawn().unwrap(), log: world.path("log") });
    drop(command);
    assert_eq!(world.narrate("person", "They walk to the kitchen.\nThey open the fridge.\n").0, 0);
    assert_eq!(status(&world).accepted, 2);
    // The daemon writes a line in full or drops it.
    let full = rustix::io::ioctl_fionread(&unread).unwrap() as usize + 512 > room;
    assert!(full, "the pipe was not full, so nothing was shown");
    assert_eq!(world.end(0, Signal::TERM), Some(0), "{}", world.log(0));
}

/// Whether the process ran until SIGTERM. Otherwise it ends with an error message, never by a signal.
fn ends_in_words(mut command: Command, what: &str) -> bool {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let ran = waited(Duration::from_millis(1500), || child.try_wait().unwrap()).is_none();
    if ran {
        kill_process(Pid::from_raw(child.id().cast_signed()).unwrap(), Signal::TERM).unwrap();
    }
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    let code = output.status.code().unwrap_or_else(|| panic!("{what}: {}: {said}", output.status));
    if code != 0 {
        let last = said.lines().last().unwrap_or_default();
        assert!(last.starts_with("roomcast: ") && !said.contains("panicked"), "{what}: exit code {code}: {said}");
        println!("{what}: {last}");
    }
    code == 0
}

/// Each of these limits once gave the error "somebody is here already", or ended the process by a signal.
#[test]
#[ignore = "full"]
fn a_limit_that_is_too_low_is_named() {
    let world = World::new("limits");
    for (limit, command, part) in [
        ("--nofile=40", "daemon", "ulimit -n"),
        ("--nofile=20", "planner", "ulimit -n"),
        ("--as=102400000", "daemon", "ulimit -v"),
        ("--as=160000000", "daemon", "ulimit -v"),
        ("--as=300000000", "daemon", "ulimit -v"),
        ("--stack=65536", "daemon", "ulimit -s"),
        ("--stack=65536", "planner", "ulimit -s"),
    ] {
        let output = world.command_by(&["prlimit", limit], &[command]).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code().is_some_and(|code| code != 0), "{limit}: {}: {said}", output.status);
        assert!(said.lines().last().is_some_and(|last| last.contains(part)), "{limit}: {said}");
    }
}

/// A context has the size of a usual window, so the check before the load is the one that a limit meets.
#[test]
#[ignore = "full"]
fn too_little_address_space_is_named_up_to_the_first_success() {
    let world = World::new("address-space");
    let mut refused = 0;
    for megabytes in 100..400_u64 {
        let mut command = Command::new("prlimit");
        command.arg(format!("--as={}", megabytes * 1_000_000)).arg(env!("CARGO_BIN_EXE_roomcast"));
        command.args(["score", "--narration", "They open the fridge."]).current_dir(world.directory.path());
        let output = command.output().unwrap();
        if output.status.success() {
            break;
        }
        let said = String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or_default().to_owned();
        assert!(said.contains("raise the limit"), "{megabytes} MB: {said}");
        refused += 1;
    }
    assert!((1..300).contains(&refused), "{refused}");
}

#[test]
#[ignore = "full"]
fn too_little_of_what_the_daemon_needs_is_an_error_in_words_and_leaves_nothing_broken() {
    let world = World::new("little");
    let limits = |option: &str, values: &[u32]| -> Vec<Vec<String>> {
        values.iter().map(|value| vec!["prlimit".into(), format!("--{option}={value}")]).collect()
    };
    let mounts = |sizes: &[&str]| -> Vec<Vec<String>> {
        let mount = |size| format!("mount -t tmpfs -o size={size} tmpfs /dev/shm && exec \"$@\"");
        let prefix = |size| ["unshare", "-m", "sh", "-c", &mount(size), "sh"].map(str::to_owned).into();
        sizes.iter().map(prefix).collect()
    };
    let mut cases =
        vec![limits("nofile", &[8, 14, 22, 30]), limits("fsize", &[1 << 14, 1 << 18, 3_000_000, 10_000_000])];
    if may_mount() {
        cases.push(mounts(&["4k", "1m", "9m"]));
    }
    for prefixes in cases {
        let mut refused = 0;
        for prefix in &prefixes {
            let prefix: Vec<&str> = prefix.iter().map(String::as_str).collect();
            refused += usize::from(!ends_in_words(world.command_by(&prefix, &["daemon"]), &prefix.join(" ")));
        }
        assert!(refused > 0, "nothing was shown: {prefixes:?}");
        assert!(ends_in_words(world.command(&["daemon"]), "no limit"), "the next one starts");
    }
}

#[test]
#[ignore = "full"]
fn a_full_disk_costs_nothing_that_room_on_it_does_not_bring_back() {
    if !may_mount() {
        return;
    }
    let mut world = World::new("disk");
    let state = world.path("state");
    fs::create_dir(&state).unwrap();
    // Another file takes all but some pages of the 2 MiB.
    let mount = format!(
        "mount -t tmpfs -o size=2m,mode=0700 tmpfs {0} && head -c 1800k /dev/zero > {0}/other && exec \"$@\"",
        state.display()
    );
    let prefix = ["unshare", "-m", "sh", "-c", &mount, "sh"];
    world.spawn(world.command_by(&prefix, &["daemon", "--state", state.to_str().unwrap()]));
    let lines: String = (0..800).map(|number| format!("They do thing {number}.\n")).collect();
    assert_eq!(world.narrate("person", &lines).0, 0, "narration goes on");
    let status = status(&world);
    assert_eq!((status.accepted, status.missed), (800, 0));
    assert!(status.journal_failures > 0, "the disk was not full");
    assert!(world.log(0).contains("the state database cannot be written"), "{}", world.log(0));

    let inside = PathBuf::from(format!("/proc/{}/root{}", world.children[0].child.id(), state.display()));
    fs::remove_file(inside.join("other")).unwrap();
    // SQLite follows /proc/PID/root to the folder of this process, so a copy is read.
    let copy = tempfile::tempdir().unwrap();
    let kept = || {
        for file in ["roomcast.db", "roomcast.db-wal"] {
            fs::copy(inside.join(file), copy.path().join(file)).unwrap();
        }
        journal::look(copy.path()).map(|recovered| recovered.observations).unwrap_or_default()
    };
    eventually("the database catches up", || (kept().len() == 800).then_some(()));
    assert!(kept().iter().zip(0..).all(|(o, number)| o.sentence() == Some(&format!("They do thing {number}."))));
    assert_eq!(world.end(0, Signal::TERM), Some(0), "{}", world.log(0));
}

/// A copy of the program that other users can run.
fn program_for_others(directory: &Path) -> PathBuf {
    fs::set_permissions(directory, fs::Permissions::from_mode(0o755)).unwrap();
    let program = directory.join("roomcast");
    fs::copy(env!("CARGO_BIN_EXE_roomcast"), &program).unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    program
}

#[test]
#[ignore = "full"]
fn a_state_folder_that_cannot_be_written_is_named_before_anything_runs() {
    let outer = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
    let program = program_for_others(outer.path());
    let (locked, config) = (outer.path().join("locked"), outer.path().join("roomcast.toml"));
    fs::create_dir(&locked).unwrap();
    fs::set_permissions(&locked, fs::Permissions::from_mode(0o555)).unwrap();
    let (locked, file) = (locked.to_str().unwrap(), config.to_str().unwrap());
    let cannot_write = format!("cannot write into {locked}: ");
    for (state, part, remedy) in [
        (locked.to_owned(), cannot_write.clone(), "run this as the user that the services run as"),
        (format!("{locked}/new/state"), cannot_write, "run this as the user that the services run as"),
        (format!("{file}/state"), format!("{file} is no folder"), "give another folder"),
    ] {
        fs::write(&config, format!("[daemon]\nstate = {state:?}\n")).unwrap();
        fs::set_permissions(&config, fs::Permissions::from_mode(0o644)).unwrap();
        for arguments in [["config", "--check"], ["daemon", "--config"]] {
            let mut command = Command::new(&program);
            command.args(arguments).arg(&config).stdin(Stdio::null()).env_remove("ROOMCAST_ROOT");
            if geteuid().is_root() {
                // Root may write anywhere, so the program runs as another user.
                command.uid(NOBODY).gid(NOBODY);
            }
            let output = command.output().unwrap();
            let said = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(4), "{arguments:?}: {said}");
            let begin = format!("daemon.state is {state}: {part}");
            assert!(said.contains(&begin) && said.contains(remedy), "{arguments:?}: {said}");
        }
    }
}

#[test]
#[ignore = "full"]
fn another_user_can_neither_read_nor_publish() {
    if !geteuid().is_root() {
        skipped("only root can run something as another user");
        return;
    }
    let mut world = World::new("nobody");
    let program = program_for_others(world.directory.path());
    world.spawn(world.command(&["daemon"]));
    let before = status(&world);
    let as_nobody = |program: &Path, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(arguments).uid(NOBODY).gid(NOBODY).stdin(Stdio::null()).output().unwrap()
    };
    let root = world.domain.root().to_str().unwrap();
    for arguments in [&["narrate", "p0-breakfast-and-television"][..], &["planner"], &["daemon"]] {
        let joined = [arguments, &["--root", root, "--domain", world.domain.name()]].concat();
        let output = as_nobody(&program, &joined);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && said.contains("belongs to user 0"), "{arguments:?}: {said}");
    }
    // Other users cannot open the domain's files directly either.
    let prefix = world.domain.prefix();
    let shared = fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
    let shared: Vec<_> =
        shared.filter(|path| path.file_name().unwrap().to_string_lossy().starts_with(&prefix)).collect();
    assert!(!shared.is_empty());
    let mut files: Vec<_> = shared.iter().map(|path| path.to_str().unwrap()).collect();
    files.push(root);
    for file in files {
        // Every user can list names in `/dev/shm`, but not in the root path.
        let read = if file == root { "ls \"$0\"" } else { "cat \"$0\"" };
        // Ports come and go: if `dd` created a vanished file again, it would count as open.
        let write = if file == root { "touch \"$0\"/x" } else { "dd if=/dev/null of=\"$0\" conv=notrunc,nocreat" };
        for script in [read, write] {
            let output = as_nobody(Path::new("/bin/sh"), &["-c", script, file]);
            assert!(!output.status.success(), "{script}: {file} is open to user {NOBODY}");
        }
    }
    let after = status(&world);
    assert_eq!((before.epoch, after.received), (after.epoch, before.received), "the daemon has heard nothing");
    assert_eq!(world.end(0, Signal::TERM), Some(0), "{}", world.log(0));

    // A planted file with the domain's name is noticed.
    let planted = PathBuf::from(format!("/dev/shm/{prefix}planted"));
    fs::write(&planted, "").unwrap();
    std::os::unix::fs::chown(&planted, Some(NOBODY), Some(NOBODY)).unwrap();
    let error = world.domain.open("test").unwrap_err().to_string();
    fs::remove_file(&planted).unwrap();
    assert!(error.contains("belongs to user 65534"), "{error}");
}
