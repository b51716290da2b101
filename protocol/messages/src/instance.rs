//! The name of a running server.

use crate::errors::ChannelError;

/// The name of one running server, by which clients find its channels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Instance(String);

impl Instance {
    /// Checks a name.
    ///
    /// # Errors
    /// If it is not 1 to 64 letters, digits, `-` or `_`.
    pub fn new(name: &str) -> Result<Self, ChannelError> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if (1..=64).contains(&name.len()) && name.chars().all(allowed) {
            Ok(Self(name.into()))
        } else {
            Err(ChannelError::InstanceName(name.into()))
        }
    }

    pub fn name(&self) -> &str {
        &self.0
    }

    pub fn elsewhere(&self) -> ChannelError {
        ChannelError::OtherPidNamespace {
            instance: self.0.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instance_names_are_plain() {
        for good in ["default", "a-b_3", &"x".repeat(64)] {
            assert_eq!(Instance::new(good).expect("good name").name(), good);
        }
        for bad in ["", "a b", "../x", "é", &"x".repeat(65)] {
            assert!(Instance::new(bad).is_err(), "{bad:?}");
        }
    }
}
