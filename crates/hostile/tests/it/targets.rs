//! Runs each target over its inputs, and checks that each target has a test, a program and inputs.

use std::fs;

use task_hostile::TARGETS;

use crate::corpus::{directory, inputs, run};

#[test]
fn no_archive_does_harm() {
    run("archive");
}

#[test]
fn no_desired_state_does_harm() {
    run("desired");
}

#[test]
fn no_envelope_does_harm() {
    run("envelope");
}

#[test]
fn no_task_manifest_does_harm() {
    run("manifest");
}

#[test]
fn no_mqtt_packet_does_harm() {
    run("mqtt_packets");
}

#[test]
fn no_mqtt_session_does_harm() {
    run("mqtt_session");
}

#[test]
fn no_name_does_harm() {
    run("names");
}

#[test]
fn no_oci_manifest_does_harm() {
    run("oci_manifest");
}

#[test]
fn no_package_xml_does_harm() {
    run("package_xml");
}

#[test]
fn no_part_does_harm() {
    run("part");
}

#[test]
fn no_proxy_header_does_harm() {
    run("proxy_header");
}

#[test]
fn no_question_or_reply_does_harm() {
    run("reply");
}

#[test]
fn no_report_does_harm() {
    run("report");
}

#[test]
fn no_rtps_datagram_does_harm_or_takes_memory() {
    run("rtps");
}

#[test]
fn no_selector_does_harm() {
    run("selector");
}

#[test]
fn no_task_toml_does_harm() {
    run("task_toml");
}

#[test]
fn no_token_does_harm() {
    run("token");
}

#[test]
fn no_websocket_frame_does_harm() {
    run("websocket");
}

/// A stack overflow ends the process and cannot be caught.
#[test]
fn deep_nesting_does_no_harm() {
    const DEPTH: usize = 200_000;
    let nested = |before: &str, open: &str, close: &str| {
        [
            before.to_owned() + &open.repeat(DEPTH),
            before.to_owned() + &open.repeat(DEPTH) + &close.repeat(DEPTH),
        ]
    };
    let inputs = [
        nested("", "[", "]"),
        nested("", "{\"a\":", "}"),
        nested("{\"tasks\":", "[", "]}"),
        nested("{\"layers\":", "[", "]}"),
        nested("{\"payload\":", "{\"a\":", "}"),
        nested("a = ", "[", "]"),
        nested("a = ", "{ a = ", " }"),
        nested("", "a.", "a = 1"),
        nested("[", "a.", "a]"),
        nested("[parameters.'/a']\na = ", "[", "]"),
        nested("", "<a>", "</a>"),
        nested("<package format=\"3\">", "<depend>", "</depend>"),
        nested("", "<!--", "-->"),
        nested("", "!(", ")"),
        nested("", "a,!", "a"),
    ];
    for target in TARGETS {
        inputs.iter().flatten().for_each(|input| (target.run)(input.as_bytes()));
    }
}

#[test]
fn every_target_is_run_here_and_by_the_fuzzer() {
    let fuzz = directory().join("..");
    let listed = fs::read_to_string(fuzz.join("Cargo.toml")).expect("fuzz/Cargo.toml");
    for name in TARGETS.map(|target| target.name) {
        assert!(
            include_str!("targets.rs").contains(&format!("    run(\"{name}\");")),
            "no test for {name}"
        );
        assert!(
            listed.contains(&format!("name = \"{name}\"\npath = \"fuzz_targets/{name}.rs\"")),
            "{name} is not listed"
        );
        let program =
            fs::read_to_string(fuzz.join(format!("fuzz_targets/{name}.rs"))).expect("its program");
        assert!(
            program.contains(&format!("task_hostile::{name}(bytes)")),
            "{name} runs something else"
        );
    }
}

#[test]
fn corpus_stays_small() {
    let size: usize =
        TARGETS.iter().flat_map(|target| inputs(target.name)).map(|(_, bytes)| bytes.len()).sum();
    assert!(size <= 300 * 1024, "fuzz/corpus has {size} bytes: minimise it");
}
