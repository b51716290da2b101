//! Where a network computes.

use candle_core::Device;
use std::fmt;
use std::str::FromStr;
use thiserror::Error;

/// A kind of device, as on the command line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum DeviceKind {
    /// The processor, with our operators.
    #[default]
    Cpu,
    /// The first NVIDIA GPU, with candle's operators.
    Cuda,
    /// The first GPU of a Mac, with candle's operators.
    Metal,
}

/// A device that cannot be used.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// Not a kind of device.
    #[error("device: expected cpu, cuda or metal, got {0:?}")]
    Unknown(String),
    /// The program cannot use it.
    #[error(
        "device {0}: expected a program that was built for it, got one without: build it with \
         `cargo build --release --features {0}`"
    )]
    NotBuilt(DeviceKind),
    /// The machine lacks it, or its driver does not work.
    #[error("device {kind}: expected one that works, got: {problem}")]
    Fails {
        /// The device.
        kind: DeviceKind,
        /// candle's words.
        problem: String,
    },
}

impl DeviceKind {
    /// Opens the first device of the kind.
    ///
    /// # Errors
    /// [`DeviceError`] for one that this program or machine lacks.
    pub fn open(self) -> Result<Device, DeviceError> {
        let (is_built, device): (_, fn(usize) -> _) = match self {
            Self::Cpu => return Ok(Device::Cpu),
            Self::Cuda => (cfg!(feature = "cuda"), Device::new_cuda),
            Self::Metal => (cfg!(feature = "metal"), Device::new_metal),
        };
        if !is_built {
            return Err(DeviceError::NotBuilt(self));
        }
        device(0).map_err(|error: candle_core::Error| DeviceError::Fails {
            kind: self,
            problem: error.to_string(),
        })
    }
}

impl FromStr for DeviceKind {
    type Err = DeviceError;

    fn from_str(text: &str) -> Result<Self, DeviceError> {
        match text {
            "cpu" => Ok(Self::Cpu),
            "cuda" => Ok(Self::Cuda),
            "metal" => Ok(Self::Metal),
            _ => Err(DeviceError::Unknown(text.to_owned())),
        }
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
    fn a_device_that_was_not_built_in_is_refused_by_name_with_what_to_do() {
        for (name, is_built) in [
            ("cpu", true),
            ("cuda", cfg!(feature = "cuda")),
            ("metal", cfg!(feature = "metal")),
        ] {
            let kind: DeviceKind = name.parse().expect("a kind");
            assert_eq!(kind.to_string(), name);
            match kind.open() {
                Err(DeviceError::NotBuilt(_)) if !is_built => {
                    let words = DeviceError::NotBuilt(kind).to_string();
                    assert!(words.contains(&format!("--features {name}")), "{words}");
                }
                result => assert!(is_built, "{result:?}"),
            }
        }
        let error = "gpu".parse::<DeviceKind>().expect_err("no kind");
        let words = "device: expected cpu, cuda or metal, got \"gpu\"";
        assert_eq!(error.to_string(), words);
    }
}
