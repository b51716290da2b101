//! The device that a network computes on.

use candle_core::{Device, Result as CandleResult};

/// The names of devices: the CPU, with our operators, and the first NVIDIA and Apple GPU, with candle's operators.
pub const DEVICES: [&str; 3] = ["cpu", "cuda", "metal"];

/// Opens a device by its name in [`DEVICES`].
///
/// # Errors
/// If this program has no support for the device, or the device cannot be opened.
pub fn open_device(name: &str) -> Result<Device, String> {
    let (is_built, device): (_, fn(usize) -> CandleResult<Device>) = match name {
        "cuda" => (cfg!(feature = "cuda"), Device::new_cuda),
        "metal" => (cfg!(feature = "metal"), Device::new_metal),
        _ => return Ok(Device::Cpu),
    };
    if !is_built {
        return Err(format!(
            "device {name}: this program was built without support for it: rebuild it with `cargo build --release \
             --features {name}`"
        ));
    }
    device(0).map_err(|error| format!("device {name}: cannot open it: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unsupported_device_is_rejected_by_name() {
        let built = [true, cfg!(feature = "cuda"), cfg!(feature = "metal")];
        for (name, is_built) in DEVICES.into_iter().zip(built) {
            let opened = open_device(name);
            let words = format!("--features {name}");
            assert!(is_built || opened.is_err_and(|error| error.contains(&words)));
        }
    }
}
