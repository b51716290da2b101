//! Tests of the DQN. The reference uses candle's linear layers and AdamW, which is Adam without weight decay.

use crate::synthetic::find;
use candle_core::{Device, Result, Tensor, Var};
use candle_nn::{AdamW, Optimizer, ParamsAdamW};
use emberwatch_model::randomness::split_mix;
use emberwatch_network::{
    Dqn, DqnSettings, DqnShape, NamedTensor, NetworkError, NotFinite, Transition,
};

const N_INPUTS: usize = 6;
const N_ACTIONS: usize = 4;
const ACTIONS: DqnShape = DqnShape {
    n_inputs: N_INPUTS,
    n_outputs: N_ACTIONS,
    n_candidates: 1,
};

fn number(index: u64) -> f32 {
    (split_mix(3, index) >> 40) as f32 / (1 << 23) as f32 - 1.0
}

fn batch(update: u64) -> Vec<Transition> {
    let row = |row: u64| {
        let first = (update * 64 + row) * 100;
        let vector = |offset: u64| {
            (0..N_INPUTS as u64)
                .map(|i| number(first + offset + i))
                .collect()
        };
        Transition {
            input: vector(0),
            action: (split_mix(4, first) % N_ACTIONS as u64) as usize,
            reward: 3.0 * number(first + 50),
            next: vector(20),
            discount: [0.99, 0.5, 0.0][row as usize % 3],
        }
    };
    (0..64).map(row).collect()
}

/// Returns the network's biases and weights, layer by layer.
fn layers(dqn: &Dqn) -> impl Iterator<Item = NamedTensor> {
    let tensors = dqn.named_tensors().into_iter();
    tensors.filter(|tensor| tensor.0.starts_with("dqn.network."))
}

fn values(layers: &[Tensor], input: &Tensor) -> Result<Tensor> {
    let mut x = input.clone();
    for (index, layer) in layers.chunks(2).enumerate() {
        x = x.matmul(&layer[1].t()?)?.broadcast_add(&layer[0])?;
        x = if index < 2 { x.relu()? } else { x };
    }
    Ok(x)
}

fn stock_loss(
    layers: &[Tensor],
    targets: &[Tensor],
    batch: &[Transition],
    double: bool,
) -> Result<Tensor> {
    let column =
        |number: fn(&Transition) -> f32| Tensor::from_iter(batch.iter().map(number), &Device::Cpu);
    let rows = |row: fn(&Transition) -> &[f32]| {
        let rows: Vec<&[f32]> = batch.iter().map(row).collect();
        Tensor::from_vec(rows.concat(), (batch.len(), N_INPUTS), &Device::Cpu)
    };
    let next = rows(|it| &it.next)?;
    let judge = values(if double { layers } else { targets }, &next)?;
    let chosen = judge.argmax_keepdim(1)?;
    let bootstrap = values(targets, &next)?.gather(&chosen, 1)?.squeeze(1)?;
    let goal = (column(|it| it.reward)? + (bootstrap * column(|it| it.discount)?)?)?.detach();
    let actions = Tensor::from_iter(batch.iter().map(|it| it.action as u32), &Device::Cpu)?;
    let got = values(layers, &rows(|it| &it.input)?)?;
    let got = got.gather(&actions.unsqueeze(1)?, 1)?.squeeze(1)?;
    (got - goal)?.sqr()?.mean_all()
}

#[test]
fn updates_are_those_of_stock_layers() -> Result<()> {
    for double in [false, true] {
        let settings = DqnSettings {
            double,
            ..DqnSettings::paper()
        };
        let mut dqn = Dqn::new(settings, ACTIONS, 1);
        let var = |(_, dims, numbers): NamedTensor| {
            Var::from_tensor(&Tensor::from_vec(numbers, dims, &Device::Cpu)?)
        };
        let vars: Vec<Var> = layers(&dqn).map(var).collect::<Result<_>>()?;
        let copies = || {
            let copy = |var: &Var| var.as_detached_tensor().copy();
            vars.iter().map(copy).collect::<Result<Vec<_>>>()
        };
        let mut targets = copies()?;
        let adam = ParamsAdamW {
            lr: 0.01,
            weight_decay: 0.0,
            ..ParamsAdamW::default()
        };
        let mut optimiser = AdamW::new(vars.clone(), adam)?;
        for update in 0..5 {
            let batch = batch(update);
            let layers: Vec<Tensor> = vars.iter().map(|var| var.as_tensor().clone()).collect();
            let loss = stock_loss(&layers, &targets, &batch, double)?;
            optimiser.backward_step(&loss)?;
            let (got, expected) = (dqn.learn(&batch).expect("finite"), loss.to_scalar::<f32>()?);
            assert!(
                (got / expected - 1.0).abs() < 1e-4,
                "{update}: {got} {expected}"
            );
            for (target, now) in targets.iter_mut().zip(copies()?) {
                *target = ((&*target * 0.99)? + (now * 0.01)?)?;
            }
        }
        for ((name, _, got), var) in layers(&dqn).zip(&vars) {
            let expected: Vec<f32> = var.flatten_all()?.to_vec1()?;
            let off = got.iter().zip(&expected).map(|(a, b)| (a - b).abs());
            // Adam's step is .01 regardless of the gradient's magnitude, so rounding errors of gradients near zero are
            // visible.
            assert!(off.fold(0.0, f32::max) < 1e-3, "{name}");
        }
    }
    Ok(())
}

#[test]
fn one_action_in_ten_is_random() {
    let dqn = Dqn::new(DqnSettings::paper(), ACTIONS, 1);
    let best = dqn.best(&[0.5; N_INPUTS]);
    let others = (0..1000).filter(|&step| dqn.act(&[0.5; N_INPUTS], step) != best);
    // Of 1000 actions, 100 are random, and three quarters of these differ from the best action: 75 are expected, with
    // standard deviation 8.
    let n_others = others.count();
    assert!((45..105).contains(&n_others), "{n_others}");
}

/// Creates a DQN with a full replay buffer and one update.
fn learner(settings: DqnSettings, seed: u64) -> Dqn {
    let mut dqn = Dqn::new(settings, ACTIONS, seed);
    for transition in (0..3).flat_map(batch) {
        dqn.remember(transition);
    }
    dqn.update().expect("finite").expect("enough transitions");
    dqn
}

fn small() -> DqnSettings {
    DqnSettings {
        replay: 150,
        ..DqnSettings::paper()
    }
}

type Saved = (Vec<NamedTensor>, u64);

fn saved(dqn: &Dqn) -> Saved {
    (dqn.named_tensors(), dqn.n_updates())
}

fn load(dqn: &mut Dqn, (tensors, n_updates): &Saved) -> std::result::Result<(), NetworkError> {
    dqn.load(|name, dims| find(tensors, name, dims), *n_updates)
}

#[test]
fn a_loaded_dqn_learns_like_the_saved_one() {
    let mut dqn = learner(small(), 2);
    dqn.set_learning_rate(0.003);
    let whole = saved(&dqn);
    let mut resumed = Dqn::new(*dqn.settings(), ACTIONS, 2);
    let mut part = whole.clone();
    part.0.retain(|tensor| tensor.0 != "dqn.target.2.bias");
    let before = saved(&resumed);
    let error = load(&mut resumed, &part)
        .expect_err("a missing tensor")
        .to_string();
    assert!(error.ends_with("dqn.target.2.bias: missing"), "{error}");
    assert_eq!(saved(&resumed), before);
    load(&mut resumed, &whole).expect("the same sizes");
    resumed.set_learning_rate(0.003);
    for update in 0..5 {
        let rows = batch(update);
        assert_eq!(dqn.learn(&rows), resumed.learn(&rows), "update {update}");
    }
    assert_eq!(saved(&dqn), saved(&resumed));
}

#[test]
fn the_latest_transitions_are_kept_oldest_first() {
    let of_length = |replay| Dqn::new(DqnSettings { replay, ..small() }, ACTIONS, 2);
    let (mut dqn, rows) = (of_length(3), batch(0));
    for n in 1..=8 {
        dqn.remember(rows[n - 1].clone());
        assert!(dqn.remembered().iter().eq(&rows[n.saturating_sub(3)..n]));
    }
}

#[test]
fn a_number_that_is_not_finite_is_named_and_changes_nothing() {
    type Change = fn(&mut Dqn, &mut [Transition]);
    let nan: Change = |_, rows| rows[5].input[2] = f32::NAN;
    // The square of this reward is not finite.
    let huge: Change = |_, rows| rows[3].reward = 1e30;
    let rate: Change = |dqn, _| dqn.set_learning_rate(f32::INFINITY);
    for (change, tensor) in [
        (nan, "dqn.network.0.weight after the update"),
        (huge, "loss"),
        (rate, "dqn.network.0.bias after the update"),
    ] {
        let (mut dqn, mut rows) = (learner(small(), 2), batch(7));
        let before = saved(&dqn);
        change(&mut dqn, &mut rows);
        let (update, tensor) = (1, tensor.to_owned());
        let expected = NetworkError::NotFinite(NotFinite { update, tensor });
        assert_eq!(dqn.learn(&rows), Err(expected));
        assert_eq!(saved(&dqn), before);
    }
}

#[test]
fn it_learns_which_candidate_pays() {
    let settings = DqnSettings {
        double: true,
        huber: true,
        width: 16,
        ..DqnSettings::paper()
    };
    // The reward of a candidate is its first feature. The second feature is irrelevant.
    let candidates = |row: u64| -> Vec<f32> { (0..6).map(|at| number(row * 6 + at)).collect() };
    let mut dqn = Dqn::new(settings, DqnShape::of_candidates(2, 3), 1);
    for row in 0..300 {
        let chosen = candidates(row)[2 * (row as usize % 3)..][..2].to_vec();
        dqn.remember(Transition {
            action: 0,
            reward: chosen[0],
            input: chosen,
            next: candidates(row + 1),
            discount: 0.5,
        });
    }
    for _ in 0..300 {
        dqn.update().expect("finite").expect("enough transitions");
    }
    let right = (1000..1100).filter(|&row| {
        let now = candidates(row);
        let pays = |a: &usize, b: &usize| now[2 * a].total_cmp(&now[2 * b]);
        Some(dqn.best(&now)) == (0..3).max_by(pays)
    });
    assert!(right.count() > 90);
    // Equal candidates have equal values, whatever their index.
    let (one, other) = ([0.5, 0.1], [-0.3, 0.2]);
    let values = dqn.values(&[one, other, one].concat());
    assert_eq!(values[0], values[2]);
}

#[test]
fn hubers_loss_grows_linearly_with_large_errors() {
    let loss = |reward: f32, huber: bool| {
        let settings = DqnSettings { huber, ..small() };
        let mut dqn = Dqn::new(settings, ACTIONS, 2);
        let mut row = batch(0).swap_remove(0);
        row.discount = 0.0;
        row.reward = dqn.values(&row.input)[row.action] + reward;
        dqn.learn(&[row]).expect("finite")
    };
    let near = |got: f32, expected: f32| (got - expected).abs() < 1e-3 * expected;
    assert!(near(loss(0.5, true), 0.125) && near(loss(-9.0, true), 8.5));
    assert!(near(loss(-9.0, false), 81.0));
}
