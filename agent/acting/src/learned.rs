//! Learned values, loaded from checkpoints: at most one value of each type.

use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

/// Values from checkpoints, for the beliefs and goals that use them. Clones share the values.
#[derive(Debug, Clone, Default)]
pub struct Learned {
    values: Vec<Arc<dyn Value>>,
}

trait Value: Any + Debug + Send + Sync {}

impl<T: Any + Debug + Send + Sync> Value for T {}

impl Learned {
    /// Returns the value of type `T`, if a checkpoint contained one.
    pub fn get<T: Any>(&self) -> Option<&T> {
        let mut values = self.values.iter();
        values.find_map(|value| {
            let value: &dyn Any = &**value;
            value.downcast_ref()
        })
    }

    /// Returns the same value as [`Self::get`], with shared ownership.
    pub fn shared<T: Any + Send + Sync>(&self) -> Option<Arc<T>> {
        let mut values = self.values.iter();
        values.find_map(|value| {
            let value: Arc<dyn Any + Send + Sync> = value.clone();
            value.downcast().ok()
        })
    }

    /// Stores a value, and drops any earlier value of the same type. Returns whether the dropped value was different.
    pub fn put<T: Any + Debug + Send + Sync + PartialEq>(&mut self, value: T) -> bool {
        let is_other = self.get::<T>().is_some_and(|before| *before != value);
        self.values.retain(|before| {
            let before: &dyn Any = &**before;
            !before.is::<T>()
        });
        self.values.push(Arc::new(value));
        is_other
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_type_has_one_value() {
        let mut learned = Learned::default();
        assert_eq!(learned.get::<u8>(), None);
        assert!(!learned.put(3_u8) && !learned.put("text"));
        assert!(!learned.put(3_u8), "the same");
        assert!(learned.put(4_u8), "another");
        assert_eq!(learned.get::<u8>(), Some(&4));
        assert_eq!(learned.get::<&str>(), Some(&"text"));
    }
}
