//! The networks' tensors in checkpoints.

use crate::learning::checkpoint::{Contents, Problem, Tensor};
use ::network::{Dqn, NamedTensor};

/// Updates of the DQN, among a checkpoint's texts.
const DQN_UPDATES: &str = "dqn.updates";

/// Adds tensors to a checkpoint.
pub fn save_tensors(tensors: Vec<NamedTensor>, contents: &mut Contents) {
    for (name, shape, numbers) in tensors {
        contents.tensors.insert(name, Tensor { shape, numbers });
    }
}

/// Finds a tensor's numbers by its name and shape.
pub fn find(contents: &Contents) -> impl Fn(&str, &[usize]) -> Result<Vec<f32>, Problem> + '_ {
    move |name, shape| contents.tensor(name, shape).map(<[f32]>::to_vec)
}

/// Adds a DQN to a checkpoint.
pub fn save_dqn(dqn: &Dqn, contents: &mut Contents) {
    save_tensors(dqn.named_tensors(), contents);
    let updates = dqn.n_updates().to_string();
    contents.texts.insert(DQN_UPDATES.into(), updates);
}

/// Takes over what [`save_dqn`] gave, of a DQN of the same inputs and actions.
///
/// # Errors
/// [`Problem`] names the tensor; nothing has changed then.
pub fn load_dqn(dqn: &mut Dqn, contents: &Contents) -> Result<(), Problem> {
    let rewards = contents.tensors.get("dqn.replay.reward");
    let n_remembered = rewards.map_or(0, |tensor| tensor.numbers.len());
    dqn.load(find(contents), n_remembered, contents.count(DQN_UPDATES)?)
}
