//! Reads a ROS `package.xml`, formats 1 to 3 (REP 127, 140, 149): the few elements that matter
//! here, and the rules by which ROS's own tools would reject the file, because they reject
//! silently.

use roxmltree::{Document, Node};

/// The file's name in a package.
pub const FILE: &str = "package.xml";

/// Contents of the file.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct PackageXml {
    /// `<name>`; empty if absent.
    pub name: String,
    /// `<version>`; empty if absent.
    pub version: String,
    /// `<build_type>` in `<export>`; without one, catkin if that is the build tool.
    pub build_type: BuildType,
    /// Names from exec_depend, depend and run_depend, sorted, without duplicates. Conditional
    /// dependencies are left out: only a robot can evaluate them.
    pub exec_depends: Vec<String>,
    /// Names with a condition.
    pub conditional_depends: Vec<String>,
    /// Reasons for which catkin_pkg, and with it colcon and catkin, would refuse the file.
    pub invalid: Vec<String>,
}

/// The build type in the file.
#[derive(Debug, Default, PartialEq, Eq)]
pub enum BuildType {
    #[default]
    /// The file has no `<build_type>`, and catkin is not its build tool.
    Absent,
    /// One type, or catkin as the build tool.
    One(String),
    /// Several, told apart by conditions.
    Several(Vec<String>),
}

impl PackageXml {
    /// Whether the file declares a runtime dependency on `package`, under whatever condition.
    pub fn depends_on(&self, package: &str) -> bool {
        self.exec_depends.iter().chain(&self.conditional_depends).any(|name| name == package)
    }
}

/// Parses `text`; the error gives reason and position.
pub fn parse(text: &str) -> Result<PackageXml, String> {
    let document = Document::parse(text).map_err(|error| error.to_string())?;
    let package = document.root_element();
    if !package.has_tag_name("package") {
        return Err(format!("the root element is <{}>, not <package>", package.tag_name().name()));
    }
    let format = package.attribute("format").unwrap_or("1");
    if !matches!(format, "1" | "2" | "3") {
        return Err(format!("format {format:?} is not one of 1, 2 and 3"));
    }
    let mut types: Vec<String> = children(package, "export")
        .flat_map(|export| children(export, "build_type").map(text_of).collect::<Vec<_>>())
        .collect();
    types.dedup();
    let build_type = match types.len() {
        // Formats without build types knew only catkin, which had to be named as the build tool.
        0 if texts(package, "buildtool_depend").any(|name| name == "catkin") => {
            BuildType::One("catkin".to_owned())
        }
        0 => BuildType::Absent,
        1 => BuildType::One(types.remove(0)),
        _ => BuildType::Several(types),
    };
    let (conditional_depends, exec_depends) = (depends(package, true), depends(package, false));
    Ok(PackageXml {
        name: texts(package, "name").next().unwrap_or_default(),
        version: texts(package, "version").next().unwrap_or_default(),
        build_type,
        exec_depends,
        conditional_depends,
        invalid: invalid(package),
    })
}

/// Runtime dependencies of the package, with or without a condition.
fn depends(package: Node<'_, '_>, conditional: bool) -> Vec<String> {
    let tags = ["exec_depend", "depend", "run_depend"];
    let elements = tags.iter().flat_map(|tag| children(package, tag));
    let mut names: Vec<String> = elements
        .filter(|element| element.has_attribute("condition") == conditional)
        .map(text_of)
        .collect();
    names.retain(|name| !name.is_empty());
    names.sort();
    names.dedup();
    names
}

/// The rules of catkin_pkg's `Package.validate`: a file that breaks a rule is no ROS package to
/// colcon, which then silently builds an ament_python package as plain Python, without its ROS
/// index entries.
fn invalid(package: Node<'_, '_>) -> Vec<String> {
    let mut invalid = Vec::new();
    for tag in ["name", "version", "description"] {
        match texts(package, tag).count() {
            1 => {}
            0 => invalid.push(format!("<{tag}> is missing or empty")),
            _ => invalid.push(format!("<{tag}> appears more than once")),
        }
    }
    if let Some(name) = texts(package, "name").next()
        && !is_package_name(&name)
    {
        invalid.push(format!("<name>: {name:?} is not a ROS package name"));
    }
    if let Some(version) = texts(package, "version").next()
        && !is_version(&version)
    {
        invalid.push(format!("<version>: {version:?} is not three numbers like 1.0.0"));
    }
    if texts(package, "license").next().is_none() {
        invalid.push("<license> is missing or empty".to_owned());
    }
    if children(package, "maintainer").next().is_none() {
        invalid.push("<maintainer> is missing".to_owned());
    }
    for maintainer in children(package, "maintainer") {
        match maintainer.attribute("email") {
            None => invalid.push(format!("<maintainer>: {:?} has no email", text_of(maintainer))),
            Some(email) if !is_email(email) => {
                invalid.push(format!("<maintainer>: {email:?} is not a valid e-mail address"))
            }
            Some(_) => {}
        }
    }
    for author in children(package, "author") {
        if let Some(email) = author.attribute("email").filter(|email| !is_email(email)) {
            invalid.push(format!("<author>: {email:?} is not a valid e-mail address"));
        }
    }
    invalid
}

fn children<'a, 'input>(
    node: Node<'a, 'input>,
    tag: &'a str,
) -> impl Iterator<Item = Node<'a, 'input>> {
    node.children().filter(move |child| child.has_tag_name(tag))
}

fn text_of(node: Node<'_, '_>) -> String {
    node.text().unwrap_or_default().trim().to_owned()
}

/// The texts of all children `tag` that have any; markup inside a description counts as text.
fn texts<'a>(node: Node<'a, '_>, tag: &'a str) -> impl Iterator<Item = String> {
    children(node, tag)
        .map(|child| {
            let text: String =
                child.descendants().filter(Node::is_text).filter_map(|text| text.text()).collect();
            text.trim().to_owned()
        })
        .filter(|text| !text.is_empty())
}

fn is_package_name(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'-'))
}

fn is_version(version: &str) -> bool {
    let numbers: Vec<_> = version.split('.').collect();
    numbers.len() == 3
        && numbers.iter().all(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
}

fn is_email(email: &str) -> bool {
    let words = |text: &str, extra: &[u8]| {
        text.split('.').all(|word| {
            !word.is_empty()
                && word.bytes().all(|b| b.is_ascii_alphanumeric() || extra.contains(&b))
        })
    };
    let Some((local, domain)) = email.split_once('@') else { return false };
    let Some((domain, last)) = domain.rsplit_once('.') else { return false };
    words(local, b"-_%+")
        && words(domain, b"-%")
        && last.len() >= 2
        && last.bytes().all(|b| b.is_ascii_alphabetic())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TALKER: &str = r#"<?xml version="1.0"?>
        <?xml-model href="http://download.ros.org/schema/package_format3.xsd" schematypens="http://www.w3.org/2001/XMLSchema"?>
        <package format="3">
          <name>talker</name><version>1.2.3</version><description>Says <b>hello</b>.</description>
          <maintainer email="a@example.org">A</maintainer><license>Apache-2.0</license>
          <exec_depend>rclpy</exec_depend><depend>std_msgs</depend><depend>rclpy</depend>
          <exec_depend condition="$ROS_VERSION == 1">rospy</exec_depend><test_depend>pytest</test_depend>
          <export><build_type>ament_python</build_type></export>
        </package>"#;

    #[test]
    fn relevant_elements_are_read() {
        let xml = parse(TALKER).expect("valid");
        assert_eq!((xml.name.as_str(), xml.version.as_str()), ("talker", "1.2.3"));
        assert_eq!(xml.build_type, BuildType::One("ament_python".to_owned()));
        assert_eq!(
            (&*xml.exec_depends, &*xml.conditional_depends),
            (&["rclpy", "std_msgs"].map(str::to_owned)[..], &["rospy".to_owned()][..])
        );
        assert_eq!(xml.invalid, Vec::<String>::new());
    }

    #[test]
    fn format_one_is_catkin() {
        let text = TALKER
            .replace(" format=\"3\"", "")
            .replace(
                "<export><build_type>ament_python</build_type></export>",
                "<buildtool_depend>catkin</buildtool_depend>",
            )
            .replace("exec_depend", "run_depend");
        let xml = parse(&text).expect("valid");
        assert_eq!(xml.build_type, BuildType::One("catkin".to_owned()));
        assert_eq!(xml.exec_depends, ["rclpy", "std_msgs"]);
    }

    #[test]
    fn files_that_colcon_would_ignore_are_reported() {
        for (from, to, reason) in [
            (
                "a@example.org",
                "a@localhost",
                "<maintainer>: \"a@localhost\" is not a valid e-mail address",
            ),
            ("a@example.org", "", "<maintainer>: \"\" is not a valid e-mail address"),
            (" email=\"a@example.org\"", "", "<maintainer>: \"A\" has no email"),
            ("<license>Apache-2.0</license>", "", "<license> is missing or empty"),
            ("1.2.3", "1.2", "<version>: \"1.2\" is not three numbers like 1.0.0"),
            (
                "<name>talker</name>",
                "<name>my talker</name>",
                "<name>: \"my talker\" is not a ROS package name",
            ),
            ("<name>talker</name>", "", "<name> is missing or empty"),
        ] {
            let xml = parse(&TALKER.replace(from, to)).expect("well-formed");
            assert_eq!(xml.invalid, [reason]);
        }
    }

    #[test]
    fn other_documents_are_refused() {
        assert!(parse("<package><name>").is_err());
        assert_eq!(parse("<robot/>"), Err("the root element is <robot>, not <package>".to_owned()));
        assert_eq!(
            parse("<package format=\"4\"/>"),
            Err("format \"4\" is not one of 1, 2 and 3".to_owned())
        );
    }

    #[test]
    fn addresses_follow_catkin_pkg() {
        for good in ["a@b.cc", "a.b+c@d-e.f.org", "a_%@x.io"] {
            assert!(is_email(good), "{good}");
        }
        for bad in [
            "",
            "a",
            "a@b",
            "a@b.c",
            "a@@b.cc",
            "a..b@c.dd",
            "a@b..cc",
            "a@b.c1",
            "a b@c.dd",
            "ä@b.cc",
        ] {
            assert!(!is_email(bad), "{bad}");
        }
    }
}
