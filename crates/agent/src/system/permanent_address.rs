//! The permanent hardware address of a network interface, whatever address it uses now: a robot's
//! Wi-Fi may make up a new one for each network. This module asks the kernel by the ioctl that
//! `ethtool -P` uses, and does nothing else.

use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::os::fd::AsRawFd;

use nix::errno::Errno;
use task_proto::MacAddress;

const SIOCETHTOOL: libc::c_ulong = 0x8946;
const ETHTOOL_GPERMADDR: u32 = 0x20;
/// Maximum length of an address in the kernel.
const MAX_ADDRESS: usize = 32;
/// Length of an Ethernet address.
const MAC: usize = 6;

#[repr(C)]
struct PermanentAddress {
    command: u32,
    size: u32,
    address: [u8; MAX_ADDRESS],
}

/// `struct ifreq`, whose second part is as large as its largest member.
#[repr(C)]
struct InterfaceRequest {
    name: [u8; libc::IFNAMSIZ],
    answer: *mut PermanentAddress,
    rest: [u8; 16],
}

/// The permanent address of `interface`; `None` where the kernel knows none, as for interfaces
/// without hardware.
pub fn of(interface: &str) -> io::Result<Option<MacAddress>> {
    let mut request =
        InterfaceRequest { name: [0; libc::IFNAMSIZ], answer: std::ptr::null_mut(), rest: [0; 16] };
    if interface.len() >= libc::IFNAMSIZ {
        return Err(io::Error::from(io::ErrorKind::InvalidInput));
    }
    request.name[..interface.len()].copy_from_slice(interface.as_bytes());
    let mut answer = PermanentAddress {
        command: ETHTOOL_GPERMADDR,
        size: MAX_ADDRESS as u32,
        address: [0; MAX_ADDRESS],
    };
    request.answer = &raw mut answer;
    // Any socket gives access to the network's interfaces; no data is sent over this one.
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    // SAFETY: both structures are laid out as the kernel's, outlive the call, and `size` is the
    // room in `answer`.
    let result = unsafe { libc::ioctl(socket.as_raw_fd(), SIOCETHTOOL as _, &raw mut request) };
    match Errno::result(result) {
        Ok(_) => Ok(parse(&answer)),
        Err(Errno::EOPNOTSUPP) => Ok(None),
        Err(errno) => Err(errno.into()),
    }
}

fn parse(answer: &PermanentAddress) -> Option<MacAddress> {
    let address = &answer.address[..MAC];
    // Zeros mean that there is no permanent address.
    if answer.size as usize != MAC || address.iter().all(|byte| *byte == 0) {
        return None;
    }
    address.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(":").parse().ok()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn permanent_address_is_six_nonzero_bytes() {
        let mut answer = PermanentAddress { command: 0, size: 6, address: [0; MAX_ADDRESS] };
        assert_eq!(parse(&answer), None);
        answer.address[..MAC].copy_from_slice(&[0, 0x11, 0x22, 0x33, 0x44, 0xff]);
        assert_eq!(parse(&answer).expect("an address").to_string(), "00:11:22:33:44:ff");
        answer.size = 20;
        assert_eq!(parse(&answer), None, "InfiniBand's");
    }

    /// The ioctl returns the same address as /sys for this machine's own interfaces.
    #[test]
    fn hardware_that_uses_its_own_address_has_it_as_the_permanent_one() {
        let read =
            |path: &Path| std::fs::read_to_string(path).unwrap_or_default().trim().to_owned();
        let mut seen = 0;
        for entry in std::fs::read_dir("/sys/class/net").expect("interfaces").flatten() {
            let is_own = read(&entry.path().join("addr_assign_type")) == "0"
                && entry.path().join("device").exists();
            let Some(used) =
                read(&entry.path().join("address")).parse::<MacAddress>().ok().filter(|_| is_own)
            else {
                continue;
            };
            assert_eq!(of(&entry.file_name().to_string_lossy()).expect("asked"), Some(used));
            seen += 1;
        }
        if seen == 0 {
            println!("unavailable: a network interface with hardware behind it");
        }
        assert!(of("no-such-if").is_err() && of("a-name-that-is-too-long").is_err());
    }

    /// Runs in a network namespace of its own, which lasts as long as this thread.
    #[test]
    #[expect(clippy::disallowed_methods, reason = "ip makes the interface that the test looks at")]
    fn interface_without_hardware_has_none() {
        let looked = std::thread::spawn(|| {
            nix::sched::unshare(nix::sched::CloneFlags::CLONE_NEWNET).ok()?;
            let words = [
                "link",
                "add",
                "one",
                "address",
                "00:11:22:33:44:55",
                "type",
                "veth",
                "peer",
                "name",
                "two",
            ];
            let made = std::process::Command::new("ip").args(words).status().ok()?;
            made.success().then(|| (of("one").expect("asked"), of("two").expect("asked")))
        });
        match looked.join().expect("no panic") {
            Some(addresses) => assert_eq!(addresses, (None, None)),
            None => println!("unavailable: a network namespace with a veth interface"),
        }
    }
}
