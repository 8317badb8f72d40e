//! The system calls that a task may not make: a seccomp filter that denies builds and tasks the
//! calls that only an administrator needs, or that mostly serve to attack a kernel. The filter is a
//! deny list, not an allow list: ROS nodes, compilers and interpreters use almost all other calls.
//! The filter is prepared before the fork; installing it makes system calls only.
//!
//! A denied call fails with EPERM. `clone3` fails with ENOSYS, so that C libraries fall back to
//! `clone`, whose flags a filter can read. All calls of another architecture are denied, because
//! their numbers differ.

use std::io;

use libc::{c_long, sock_filter};
use nix::errno::Errno;
use nix::sys::prctl;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Seccomp {
    /// Builds and tasks are filtered.
    Default,
    /// Builds and tasks are not filtered.
    Off,
}

/// The architecture of this program in the kernel's numbering; `None`: there is no filter for it.
const ARCHITECTURE: Option<u32> = if cfg!(target_arch = "x86_64") {
    Some(0xC000_003E)
} else if cfg!(target_arch = "aarch64") {
    Some(0xC000_00B7)
} else if cfg!(all(target_arch = "arm", target_endian = "little")) {
    Some(0x4000_0028)
} else {
    None
};

/// `kexec_file_load`, which some C libraries do not define.
const KEXEC_FILE_LOAD: c_long = if cfg!(target_arch = "x86_64") {
    320
} else if cfg!(target_arch = "aarch64") {
    294
} else {
    401
};

/// Calls that are denied whatever their arguments. Calls that are listed by number have the same
/// number on all architectures.
const DENIED: [c_long; 43] = [
    // Load another kernel, or code into this one.
    libc::SYS_kexec_load,
    KEXEC_FILE_LOAD,
    libc::SYS_init_module,
    libc::SYS_finit_module,
    libc::SYS_delete_module,
    libc::SYS_bpf,
    libc::SYS_perf_event_open,
    // Mounts: mount, and open_tree, move_mount, fsopen, fsconfig, fsmount, fspick, mount_setattr,
    // open_tree_attr.
    libc::SYS_mount,
    libc::SYS_umount2,
    libc::SYS_pivot_root,
    428,
    429,
    430,
    431,
    432,
    433,
    442,
    467,
    // Enter existing namespaces; the calls that make new ones are judged by their flags.
    libc::SYS_setns,
    // The kernel's key rings.
    libc::SYS_keyctl,
    libc::SYS_add_key,
    libc::SYS_request_key,
    // io_uring_setup, io_uring_enter, io_uring_register: they make calls that no filter sees.
    425,
    426,
    427,
    libc::SYS_userfaultfd,
    // Machine-wide state: log, swap, clock, quotas (quotactl_fd), accounting, power.
    libc::SYS_syslog,
    libc::SYS_swapon,
    libc::SYS_swapoff,
    libc::SYS_reboot,
    libc::SYS_settimeofday,
    libc::SYS_clock_settime,
    CLOCK_SETTIME64,
    libc::SYS_acct,
    libc::SYS_quotactl,
    443,
    libc::SYS_vhangup,
    libc::SYS_chroot,
    // Open files by handle, bypassing all directories.
    libc::SYS_open_by_handle_at,
    // Host and domain names of the machine.
    libc::SYS_sethostname,
    libc::SYS_setdomainname,
    // Ports of the processor.
    IOPL,
    IOPERM,
];

/// `clock_settime` with 64-bit times, on architectures where that is a separate call.
const CLOCK_SETTIME64: c_long =
    if cfg!(target_pointer_width = "32") { 404 } else { libc::SYS_clock_settime };
/// Calls that only x86 has; on other architectures a call that is denied anyway takes their place.
#[cfg(target_arch = "x86_64")]
const IOPL: c_long = libc::SYS_iopl;
#[cfg(not(target_arch = "x86_64"))]
const IOPL: c_long = libc::SYS_reboot;
#[cfg(target_arch = "x86_64")]
const IOPERM: c_long = libc::SYS_ioperm;
#[cfg(not(target_arch = "x86_64"))]
const IOPERM: c_long = libc::SYS_reboot;
/// `clone3`, with the same number on all architectures.
const CLONE3: c_long = 435;
/// On x86_64 the calls of the x32 ABI have this bit.
const X32_BIT: u32 = 0x4000_0000;
/// Flags of `clone` and `unshare` that make namespaces. The flag for time namespaces applies to
/// `unshare` only.
const NEW_NAMESPACES: u32 = (libc::CLONE_NEWNS
    | libc::CLONE_NEWCGROUP
    | libc::CLONE_NEWUTS
    | libc::CLONE_NEWIPC
    | libc::CLONE_NEWUSER
    | libc::CLONE_NEWPID
    | libc::CLONE_NEWNET) as u32;
const NEW_TIME_NAMESPACE: u32 = 0x80;
/// Requests of `ioctl` that type into a terminal, which other processes may share.
const TERMINAL_INPUT: [u32; 2] = [0x5412, 0x541C];

/// Offsets in `seccomp_data` of the call's number, the architecture and the low half of each
/// argument.
const NUMBER_AT: u32 = 0;
const ARCHITECTURE_AT: u32 = 4;
const FIRST_ARGUMENT_AT: u32 = 16;
const SECOND_ARGUMENT_AT: u32 = 24;

const ALLOW: u32 = libc::SECCOMP_RET_ALLOW;
const DENY: u32 = libc::SECCOMP_RET_ERRNO | libc::EPERM as u32;
const UNKNOWN: u32 = libc::SECCOMP_RET_ERRNO | libc::ENOSYS as u32;

/// A filter that is ready to be installed.
#[derive(Debug)]
pub struct CallFilter(Vec<sock_filter>);

impl CallFilter {
    /// The filter of builds and tasks; `None` where this kernel or architecture has none.
    pub fn of_tasks() -> Option<Self> {
        ARCHITECTURE.filter(|_| kernel_filters()).map(|architecture| Self(program(architecture)))
    }

    /// Installs the filter permanently for the calling process and all its descendants. This runs
    /// between fork and exec, so it makes system calls only. It also sets `no_new_privs`, without
    /// which the kernel would refuse the filter: from then on no program gains rights by being
    /// executed.
    pub fn install(&self) -> io::Result<()> {
        prctl::set_no_new_privs()?;
        // SPEC_ALLOW: otherwise older kernels slow filtered processes down, as if they ran foreign
        // code in themselves.
        match self.set(libc::SECCOMP_FILTER_FLAG_SPEC_ALLOW) {
            Err(Errno::EINVAL) => Ok(self.set(0)?),
            done => Ok(done?),
        }
    }

    fn set(&self, flags: libc::c_ulong) -> Result<(), Errno> {
        let program = libc::sock_fprog {
            len: self.0.len() as libc::c_ushort,
            filter: self.0.as_ptr().cast_mut(),
        };
        // SAFETY: the kernel copies the program, which outlives the call and is not written to.
        let set = unsafe {
            libc::syscall(
                libc::SYS_seccomp,
                libc::SECCOMP_SET_MODE_FILTER,
                flags,
                std::ptr::from_ref(&program),
            )
        };
        Errno::result(set).map(drop)
    }
}

/// Whether builds and tasks are filtered: by the setting, or else by whether they run under an
/// account of their own. Where they run under the agent's account, the denied calls may be their
/// purpose, so the filter must be enabled explicitly.
pub fn is_wanted(setting: Option<Seccomp>, has_account: bool) -> bool {
    setting.map_or(has_account, |setting| setting == Seccomp::Default)
}

fn kernel_filters() -> bool {
    let action = libc::SECCOMP_RET_ERRNO;
    // SAFETY: the kernel reads one number, which outlives the call.
    let found = unsafe {
        libc::syscall(
            libc::SYS_seccomp,
            libc::SECCOMP_GET_ACTION_AVAIL,
            0,
            std::ptr::from_ref(&action),
        )
    };
    found == 0
}

fn program(architecture: u32) -> Vec<sock_filter> {
    let mut program =
        vec![load(ARCHITECTURE_AT), jump(libc::BPF_JEQ, architecture, 1, 0), return_action(DENY)];
    program.push(load(NUMBER_AT));
    if cfg!(target_arch = "x86_64") {
        program.extend([jump(libc::BPF_JGE, X32_BIT, 0, 1), return_action(DENY)]);
    }
    for call in DENIED {
        program.extend([jump(libc::BPF_JEQ, call as u32, 0, 1), return_action(DENY)]);
    }
    program.extend([jump(libc::BPF_JEQ, CLONE3 as u32, 0, 1), return_action(UNKNOWN)]);
    for (call, flags) in [
        (libc::SYS_clone, NEW_NAMESPACES),
        (libc::SYS_unshare, NEW_NAMESPACES | NEW_TIME_NAMESPACE),
    ] {
        program.extend([
            jump(libc::BPF_JEQ, call as u32, 0, 4),
            load(FIRST_ARGUMENT_AT),
            jump(libc::BPF_JSET, flags, 0, 1),
            return_action(DENY),
            return_action(ALLOW),
        ]);
    }
    program.extend([
        jump(libc::BPF_JEQ, libc::SYS_ioctl as u32, 0, 4),
        load(SECOND_ARGUMENT_AT),
        jump(libc::BPF_JEQ, TERMINAL_INPUT[0], 1, 0),
        jump(libc::BPF_JEQ, TERMINAL_INPUT[1], 0, 1),
        return_action(DENY),
        return_action(ALLOW),
    ]);
    program
}

fn load(at: u32) -> sock_filter {
    sock_filter { code: (libc::BPF_LD | libc::BPF_W | libc::BPF_ABS) as u16, jt: 0, jf: 0, k: at }
}

fn jump(condition: u32, with: u32, if_so: u8, if_not: u8) -> sock_filter {
    sock_filter {
        code: (libc::BPF_JMP | condition | libc::BPF_K) as u16,
        jt: if_so,
        jf: if_not,
        k: with,
    }
}

fn return_action(action: u32) -> sock_filter {
    sock_filter { code: (libc::BPF_RET | libc::BPF_K) as u16, jt: 0, jf: 0, k: action }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::Path;

    use super::*;
    use crate::process::cgroup::RunLimits;
    use crate::process::confinement::Confinement;
    use crate::process::program;

    /// Each class of denied calls, made with harmless arguments. The script prints for each whether
    /// it was denied.
    const CALLS: &str = r#"
import ctypes, errno, mmap, os, platform, sys
libc = ctypes.CDLL(None, use_errno=True)
arm = platform.machine() == "aarch64"
def call(*numbers_and_arguments):
    x86, other, *arguments = numbers_and_arguments
    ctypes.set_errno(0)
    libc.syscall(other if arm else x86, *[ctypes.c_long(argument) for argument in arguments])
    return errno.errorcode.get(ctypes.get_errno(), "OK")
def in_child(made):
    reader, writer = os.pipe()
    if os.fork() == 0:
        os.write(writer, made().encode())
        os._exit(0)
    os.close(writer)
    os.wait()
    return os.read(reader, 99).decode()
def old_call():
    # getpid by its number on i386: mov eax, 20; int 0x80; ret
    code = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    code.write(bytes([0xb8, 20, 0, 0, 0, 0xcd, 0x80, 0xc3]))
    made = ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.addressof(ctypes.c_char.from_buffer(code)))
    return errno.errorcode.get(-made(), "OK")
said = {
    "kexec": call(246, 104, 0, 99, 0, -1), "module": call(175, 105, 0, 0, 0), "bpf": call(321, 280, 9999, 0, 0),
    "perf": call(298, 241, 0, 0, -1, -1, -1), "mount": call(165, 40, 0, 0, 0, 0, 0), "fsopen": call(430, 430, 0, 0),
    "namespace": in_child(lambda: call(272, 97, 0x10000000)),
    "clone": in_child(lambda: call(56, 220, 0x10000000 | 0x20000, 0, 0, 0, 0)),
    "clone3": call(435, 435, 0, 0), "setns": call(308, 268, -1, 0), "keys": call(250, 219, 0, -3, 0),
    "io_uring": call(425, 425, 0, 0), "userfaultfd": call(323, 282, 0xffff), "swap": call(167, 224, 0, 0),
    "reboot": call(169, 142, 0, 0, 0), "clock": call(227, 112, 99, 0), "accounting": call(163, 89, -1),
    "quota": call(179, 60, 0xffffff, 0, 0, 0), "handle": call(304, 265, -1, 0, 0), "log": call(103, 116, 99, 0, 0),
    "typing": call(16, 29, -1, 0x5412, 0), "typing past 32 bits": call(16, 29, -1, 0x100005412, 0),
    "x32": call(0x40000000 + 39, 172),
}
# A kernel that has no calls of i386 ends the child.
if platform.machine() == "x86_64": said["i386"] = in_child(old_call) or "EPERM"
for name, outcome in said.items(): print(name, outcome)
"#;
    /// Operations that a ROS task uses all the time.
    const USES: &str = r#"
import asyncio, ctypes, multiprocessing, socket, subprocess, threading, time
thread = threading.Thread(target=lambda: time.sleep(0)); thread.start(); thread.join()
subprocess.run(["/bin/bash", "-c", "(true &) ; wait"], check=True)
process = multiprocessing.get_context("fork").Process(target=print); process.start(); process.join()
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp: udp.bind(("127.0.0.1", 0))
memory = multiprocessing.shared_memory.SharedMemory(create=True, size=4096) if hasattr(multiprocessing, "shared_memory") else None
if memory: memory.close(); memory.unlink()
asyncio.run(asyncio.sleep(0))
print("works")
"#;

    /// Output of `script` when it runs as a build, with or without the filter.
    async fn output_of(script: &str, filter_calls: bool) -> String {
        let temp = tempfile::tempdir().expect("a directory");
        let path = temp.path().join("script");
        std::fs::write(&path, format!("exec python3 - <<'END'\n{script}\nEND\n")).expect("written");
        let limits = RunLimits { filter_calls, ..RunLimits::default() };
        let confinement = Confinement::new(&path, None, &limits, None).expect("confined");
        let environment =
            BTreeMap::from([("PATH".to_owned(), std::env::var("PATH").expect("set"))]);
        let (said, output) = io::pipe().expect("a pipe");
        let mut child =
            program::spawn_build(&path, Path::new("/"), &environment, 0, confinement, output)
                .expect("started");
        let reading = tokio::task::spawn_blocking(move || io::read_to_string(said).expect("text"));
        child.wait().await.expect("collected");
        reading.await.expect("read")
    }

    #[tokio::test]
    async fn filtered_program_is_denied_each_class_of_calls() {
        let said = output_of(CALLS, true).await;
        assert!(said.lines().count() > 20, "{said}");
        for line in said.lines() {
            let denied = if line.starts_with("clone3 ") { "ENOSYS" } else { "EPERM" };
            let is_x86_only = line.starts_with("x32 ") && !cfg!(target_arch = "x86_64");
            assert!(line.ends_with(denied) || is_x86_only, "{line}\n\n{said}");
        }
        let unfiltered = output_of(CALLS, false).await;
        let allowed = unfiltered.lines().filter(|line| !line.ends_with("EPERM")).count();
        assert!(allowed > 6, "without the filter: {unfiltered}");
    }

    #[tokio::test]
    async fn filtered_program_runs_threads_processes_and_sockets() {
        let said = output_of(USES, true).await;
        assert!(said.ends_with("works\n"), "{said}");
    }

    #[test]
    fn filter_is_the_default_only_for_tasks_with_their_own_account() {
        assert!(is_wanted(None, true) && !is_wanted(None, false));
        assert!(is_wanted(Some(Seccomp::Default), false) && !is_wanted(Some(Seccomp::Off), true));
    }
}
