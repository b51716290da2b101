//! The DQN beside candle's stock linear layers and AdamW, whose weight decay of zero makes it Adam.

use agent::network::{Dqn, DqnSettings, Transition};
use candle_core::{DType, Device, Result, Tensor, Var};
use candle_nn::{AdamW, Optimizer, ParamsAdamW};
use protocol::randomness::split_mix;

const N_INPUTS: usize = 6;
const N_ACTIONS: usize = 4;

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
        }
    };
    (0..64).map(row).collect()
}

fn values(layers: &[Tensor], input: &Tensor) -> Result<Tensor> {
    let mut x = input.clone();
    for (index, layer) in layers.chunks(2).enumerate() {
        x = x.matmul(&layer[0].t()?)?.broadcast_add(&layer[1])?;
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
    let stack =
        |rows: Vec<&[f32]>| Tensor::from_vec(rows.concat(), (batch.len(), N_INPUTS), &Device::Cpu);
    let next = stack(batch.iter().map(|row| &row.next[..]).collect())?;
    let of_target = values(targets, &next)?;
    let judge = if double {
        values(layers, &next)?
    } else {
        of_target.clone()
    };
    let chosen = judge.argmax_keepdim(1)?;
    let bootstrap = (of_target.gather(&chosen, 1)?.squeeze(1)? * f64::from(0.99_f32))?;
    let rewards: Vec<f32> = batch.iter().map(|row| row.reward).collect();
    let goal = (Tensor::new(rewards, &Device::Cpu)? + bootstrap)?.detach();
    let actions: Vec<u32> = batch.iter().map(|row| row.action as u32).collect();
    let inputs = stack(batch.iter().map(|row| &row.input[..]).collect())?;
    let actions = Tensor::new(actions, &Device::Cpu)?.unsqueeze(1)?;
    let got = values(layers, &inputs)?.gather(&actions, 1)?.squeeze(1)?;
    (got - goal)?.sqr()?.mean_all()
}

fn check(double: bool) -> Result<()> {
    let settings = DqnSettings {
        double,
        ..DqnSettings::paper()
    };
    let mut dqn = Dqn::new(settings, N_INPUTS, N_ACTIONS, 1);
    let var = |(_, dims, numbers)| -> Result<Var> {
        let (dims, numbers): (Vec<usize>, Vec<f32>) = (dims, numbers);
        Var::from_tensor(&Tensor::from_vec(numbers, dims, &Device::Cpu)?)
    };
    let vars: Vec<Var> = dqn.tensors().into_iter().map(var).collect::<Result<_>>()?;
    let copies = || {
        vars.iter()
            .map(|var| var.as_detached_tensor().copy())
            .collect::<Result<Vec<_>>>()
    };
    let mut targets = copies()?;
    let adam = ParamsAdamW {
        lr: 0.01,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-8,
        weight_decay: 0.0,
    };
    let mut optimiser = AdamW::new(vars.clone(), adam)?;
    for update in 0..5 {
        let batch = batch(update);
        let layers: Vec<Tensor> = vars.iter().map(|var| var.as_tensor().clone()).collect();
        let loss = stock_loss(&layers, &targets, &batch, double)?;
        let expected: f32 = loss.to_dtype(DType::F32)?.to_scalar()?;
        optimiser.backward_step(&loss)?;
        let got = dqn.learn(&batch);
        assert!(
            (got / expected - 1.0).abs() < 1e-4,
            "{update}: loss {got}, expected {expected}"
        );
        for (target, now) in targets.iter_mut().zip(copies()?) {
            *target = ((&*target * 0.99)? + (now * 0.01)?)?;
        }
    }
    for ((name, _, got), var) in dqn.tensors().into_iter().zip(&vars) {
        let expected: Vec<f32> = var.flatten_all()?.to_vec1()?;
        let worst = got
            .iter()
            .zip(&expected)
            .map(|(got, expected)| (got - expected).abs());
        let worst = worst.fold(0.0, f32::max);
        // Adam's step is .01 whatever the gradient, so rounding near zero gradients shows.
        assert!(worst < 1e-3, "{name}: off by {worst}");
    }
    Ok(())
}

#[test]
fn updates_are_those_of_stock_layers() {
    check(false).expect("stock layers");
}

#[test]
fn double_updates_are_those_of_stock_layers() {
    check(true).expect("stock layers");
}

#[test]
fn it_learns_which_action_pays() {
    let settings = DqnSettings {
        gamma: 0.0,
        ..DqnSettings::paper()
    };
    let mut dqn = Dqn::new(settings, 1, 2, 1);
    for index in 0..200_u64 {
        let input = if index % 2 == 0 { 1.0 } else { -1.0 };
        let action = (index / 2 % 2) as usize;
        let pays = (input > 0.0) == (action == 1);
        let reward = if pays { 1.0 } else { 0.0 };
        dqn.remember(Transition {
            input: vec![input],
            action,
            reward,
            next: vec![input],
        });
    }
    for _ in 0..200 {
        dqn.update().expect("enough transitions");
    }
    let greedy = |input: f32| {
        let values = dqn.values(&[input]);
        usize::from(values[1] > values[0])
    };
    assert_eq!([greedy(1.0), greedy(-1.0)], [1, 0]);
    let random = (0..1000).filter(|&step| dqn.act(&[1.0], step) == 0).count();
    // One in ten is random, half of those the other action: 50 in 1000, standard deviation 7.
    assert!((20..90).contains(&random), "{random}");
}
