//! The device that a network computes on.

use candle_core::{Device, Error, Result as CandleResult};
use std::fmt;
use std::str::FromStr;
use thiserror::Error as ThisError;

/// A kind of device, parsed from its name on the command line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum DeviceKind {
    /// The CPU, with our operators.
    #[default]
    Cpu,
    /// The first NVIDIA GPU, with candle's operators.
    Cuda,
    /// The first Apple GPU, with candle's operators.
    Metal,
}

/// The reason why a device cannot be used.
#[derive(Debug, ThisError)]
#[error("{0}")]
pub struct DeviceError(String);

impl DeviceKind {
    /// Opens the first device of this kind.
    ///
    /// # Errors
    /// [`DeviceError`] if this program has no support for the device, or the device cannot be opened.
    pub fn open(self) -> Result<Device, DeviceError> {
        let (is_built, device): (_, fn(usize) -> CandleResult<Device>) = match self {
            Self::Cpu => return Ok(Device::Cpu),
            Self::Cuda => (cfg!(feature = "cuda"), Device::new_cuda),
            Self::Metal => (cfg!(feature = "metal"), Device::new_metal),
        };
        if !is_built {
            return Err(DeviceError(format!(
                "device {self}: this program was built without support for it: rebuild it with \
                 `cargo build --release --features {self}`"
            )));
        }
        let fails = |error: Error| format!("device {self}: cannot open it: {error}");
        device(0).map_err(|error| DeviceError(fails(error)))
    }
}

impl FromStr for DeviceKind {
    type Err = DeviceError;

    fn from_str(text: &str) -> Result<Self, DeviceError> {
        let mut kinds = [Self::Cpu, Self::Cuda, Self::Metal].into_iter();
        let kind = kinds.find(|kind| kind.to_string() == text);
        kind.ok_or_else(|| {
            DeviceError(format!("device: expected cpu, cuda or metal, got {text:?}"))
        })
    }
}

impl fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::Metal => "metal",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unsupported_device_is_rejected_by_name() {
        for (name, is_built) in [
            ("cpu", true),
            ("cuda", cfg!(feature = "cuda")),
            ("metal", cfg!(feature = "metal")),
        ] {
            let kind: DeviceKind = name.parse().expect("a kind");
            assert_eq!(kind.to_string(), name);
            if !is_built {
                let error = kind.open().expect_err("not built").to_string();
                assert!(error.contains(&format!("--features {name}")), "{error}");
            }
        }
        let error = "gpu".parse::<DeviceKind>().expect_err("no kind");
        let words = "device: expected cpu, cuda or metal, got \"gpu\"";
        assert_eq!(error.to_string(), words);
    }
}
