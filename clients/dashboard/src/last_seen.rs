//! What is remembered of the cells that were seen. Pure.

use crate::album::Strip;
use crate::entry::Entry;
use emberwatch_protocol::frame::UNOBSERVED;

/// What each cell showed last.
pub(crate) struct LastSeen {
    /// The observation, [`UNOBSERVED`] if there was none.
    pub(crate) seen: Vec<u8>,
    /// How many steps before, at most 255.
    pub(crate) age: Vec<u8>,
    /// The first step that is remembered; 0: the episode's first.
    pub(crate) since: u64,
}

impl LastSeen {
    /// Of the steps of one run up to one of them.
    pub(crate) fn of(strip: &Strip, serial: u64, last: &Entry) -> Self {
        let n_cells = last.shape.n_cells();
        let (mut seen, mut age) = (vec![UNOBSERVED; n_cells], vec![u8::MAX; n_cells]);
        let (mut n_unseen, mut since) = (n_cells, last.result.step + 1);
        for entry in strip.run_up_to(serial) {
            let (then, now) = (&entry.result, &last.result);
            if n_unseen == 0 {
                break;
            }
            since = then.step;
            for &(cell, value) in &entry.seen {
                let cell = cell as usize;
                if seen[cell] == UNOBSERVED {
                    (seen[cell], age[cell]) = (value, (now.step - then.step).min(255) as u8);
                    n_unseen -= 1;
                }
            }
        }
        let is_complete = n_unseen == 0 || since <= 1;
        Self {
            seen,
            age,
            since: if is_complete { 0 } else { since },
        }
    }
}
