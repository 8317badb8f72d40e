//! The charge of the robot's battery, as reported by the kernel. This module decides nothing.

use std::fs;
use std::path::Path;

/// The kernel's directory of power supplies.
pub const SUPPLIES: &str = "/sys/class/power_supply";

/// Charge of the first battery in `supplies`, in percent; `None` where no battery reports its
/// charge.
pub fn percent(supplies: &Path) -> Option<u8> {
    let mut names: Vec<_> =
        fs::read_dir(supplies).ok()?.flatten().map(|entry| entry.path()).collect();
    names.sort();
    names.iter().find_map(|supply| {
        let says = |file: &str| Some(fs::read_to_string(supply.join(file)).ok()?.trim().to_owned());
        // The battery of a mouse is listed too, with another scope.
        let is_of_robot =
            says("type")? == "Battery" && says("scope").is_none_or(|scope| scope != "Device");
        says("capacity").filter(|_| is_of_robot)?.parse().ok().filter(|percent| *percent <= 100)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_battery_with_a_charge_level_counts() {
        let dir = tempfile::tempdir().unwrap();
        let supply = |name: &str, files: &[(&str, &str)]| {
            fs::create_dir(dir.path().join(name)).unwrap();
            files.iter().for_each(|(file, text)| {
                fs::write(dir.path().join(name).join(file), text).unwrap()
            });
        };
        assert_eq!(percent(dir.path()), None);
        assert_eq!(percent(&dir.path().join("absent")), None);
        supply("AC", &[("type", "Mains\n"), ("online", "1\n")]);
        supply("BAT0", &[("type", "Battery\n"), ("capacity", "full\n")]);
        supply("BAT1", &[("type", "Battery\n"), ("scope", "Device\n"), ("capacity", "3\n")]);
        assert_eq!(percent(dir.path()), None);
        supply("BAT2", &[("type", "Battery\n"), ("capacity", "87\n")]);
        supply("BAT3", &[("type", "Battery\n"), ("capacity", "12\n")]);
        assert_eq!(percent(dir.path()), Some(87));
    }
}
