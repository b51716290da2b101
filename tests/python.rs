//! Sends raw messages through `wire_reference.py`, a client that shares no code with the Rust client. The Python client
//! sends the given bytes and checks the answers itself.

use bytemuck::{AnyBitPattern, NoUninit, bytes_of, pod_read_unaligned};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::message::{ControlRequest, StepRequest};
use serde_json::json;
use std::cell::RefCell;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use tests::harness::{PATIENCE, eventually, python, repository};
use tests::wire::{ControlAnswer, RawClient, StepAnswer};

/// A Python process with both channels open.
pub struct PythonWire {
    process: RefCell<Child>,
    requests: RefCell<Option<ChildStdin>>,
    answers: RefCell<BufReader<ChildStdout>>,
}

impl PythonWire {
    /// Opens both channels of an instance. The Python client sends `hello` itself.
    pub fn open(instance: &Instance) -> Self {
        let python = python();
        let program = repository().join("tests/wire_reference.py");
        let mut process = Command::new(&python)
            .args([program.as_os_str(), instance.name().as_ref()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("start the client");
        Self {
            requests: RefCell::new(process.stdin.take()),
            answers: RefCell::new(BufReader::new(process.stdout.take().expect("piped"))),
            process: RefCell::new(process),
        }
    }

    /// Sends a request and waits for the answer. The client fails if the answer is wrong or late.
    fn exchange<R: AnyBitPattern>(
        &self,
        service: &str,
        header: &impl NoUninit,
        payload: &[u8],
    ) -> (R, Vec<u8>) {
        let request = json!({
            "service": service,
            "header": bytes_of(header),
            "payload": payload,
        });
        let mut requests = self.requests.borrow_mut();
        let requests = requests.as_mut().expect("open until it is dropped");
        writeln!(requests, "{request}").expect("tell the client");
        let mut line = String::new();
        let mut answers = self.answers.borrow_mut();
        answers.read_line(&mut line).expect("hear the client");
        let answer = serde_json::from_str::<[Vec<u8>; 2]>(&line);
        let [header, payload] = answer.expect("an answer by the client");
        (pod_read_unaligned(&header), payload)
    }
}

impl RawClient for PythonWire {
    fn step(&self, header: StepRequest, payload: &[u8]) -> StepAnswer {
        self.exchange("step", &header, payload)
    }

    fn control(&self, header: ControlRequest, payload: &[u8]) -> ControlAnswer {
        self.exchange("control", &header, payload)
    }

    fn pid(&self) -> u32 {
        self.process.borrow().id()
    }
}

impl Drop for PythonWire {
    fn drop(&mut self) {
        // The Python client ends when its standard input is closed.
        self.requests.take();
        let process = self.process.get_mut();
        if !eventually(PATIENCE, || matches!(process.try_wait(), Ok(Some(_)))) {
            let _ = process.kill();
            let _ = process.wait();
        }
    }
}
