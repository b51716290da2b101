//! Structs for C, together with the memory to which they point.

use crate::handle::put;
use std::ffi::{CString, c_char};

/// A struct of C, and the values to which it points.
pub struct View<V, O> {
    view: V,
    pub owned: O,
}

// SAFETY: the pointers of the view lead to memory of `owned`, or to memory that is never freed.
unsafe impl<V, O: Send> Send for View<V, O> {}

impl<V, O> View<V, O> {
    /// Puts a struct together with the values to which it points: heap memory, which stays where it is.
    pub fn new(view: V, owned: O) -> Self {
        Self { view, owned }
    }

    pub fn pointer(&self) -> *const V {
        &raw const self.view
    }
}

/// Keeps a new view, and writes its pointer to `to`, unless C does not want it.
pub fn keep<V, O>(kept: &mut Option<View<V, O>>, new: View<V, O>, to: *mut *const V) {
    put(to, kept.insert(new).pointer());
}

#[derive(Default)]
pub struct Texts {
    texts: Vec<CString>,
    lists: Vec<Vec<*const c_char>>,
}

// SAFETY: the pointers of the lists lead to `texts`.
unsafe impl Send for Texts {}

impl Texts {
    pub fn add(&mut self, text: &str) -> *const c_char {
        let text = CString::new(text.replace('\0', "")).unwrap_or_default();
        let pointer = text.as_ptr();
        self.texts.push(text);
        pointer
    }

    pub fn add_all(&mut self, texts: &[String]) -> *const *const c_char {
        let list: Vec<_> = texts.iter().map(|text| self.add(text)).collect();
        let pointer = list.as_ptr();
        self.lists.push(list);
        pointer
    }
}
