//! The latest observation of each cell. Does no I/O.

use crate::album::Strip;
use crate::entry::Entry;
use emberwatch_protocol::frame::UNOBSERVED;

pub(crate) struct LastSeen {
    /// The latest observation of each cell, [`UNOBSERVED`] if there was none.
    pub(crate) seen: Vec<u8>,
    /// The age of each observation in steps, at most 255.
    pub(crate) age: Vec<u8>,
    /// The first step that was searched; 0 if older steps can add nothing.
    pub(crate) since: u64,
}

impl LastSeen {
    /// Collects the observations of the run that ends at the entry `last`, whose serial number is `serial`.
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
