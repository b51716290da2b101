//! Behaviours of robots while a belief is learned. A behaviour assigns values to cells, and lasts for several steps.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::planning::{CellValues, Objective};
use emberwatch_model::{Airspace, Grid, Shape};
use emberwatch_network::Sightings;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

const STEPS: u64 = 20;

/// Time constants in steps: how fast a seen cell regains its value for the aim `Cover`, and how fast an old sighting
/// loses its value for the aim `Last`.
const FADING_STEPS: [f32; 2] = [300.0, 100.0];

/// An aim, and a goal cell, which only the aim `Far` uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Behaviour {
    aim: Aim,
    goal: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Aim {
    Walk,
    /// Cells that have not been seen for a long time.
    Cover,
    Far,
    /// Cells in which the observation with the highest reward was seen recently.
    Last,
    /// The policy's objective on the belief, plus `entropy / 10` times the belief's entropy.
    Exploit {
        entropy: u8,
    },
}

/// Each aim with its two probabilities in per cent: while exploring, and later.
const AIMS: [(Aim, [u64; 2]); 8] = [
    (Aim::Walk, [20, 4]),
    (Aim::Cover, [30, 8]),
    (Aim::Far, [10, 8]),
    (Aim::Last, [40, 5]),
    (Aim::Exploit { entropy: 0 }, [0, 30]),
    (Aim::Exploit { entropy: 1 }, [0, 15]),
    (Aim::Exploit { entropy: 3 }, [0, 15]),
    (Aim::Exploit { entropy: 10 }, [0, 15]),
];

impl Behaviour {
    /// Returns another random behaviour with probability 1 / `STEPS` or at the beginning, otherwise the previous one.
    pub fn next(
        before: Option<Self>,
        is_exploring: bool,
        shape: Shape,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let changes = rng.next_u64().is_multiple_of(STEPS);
        if let Some(before) = before.filter(|_| !changes) {
            return before;
        }
        let stage = usize::from(!is_exploring);
        let mut chance = rng.next_u64() % 100;
        let mut aims = AIMS.iter().skip_while(|(_, chances)| {
            let is_passed = chance >= chances[stage];
            chance = chance.saturating_sub(chances[stage]);
            is_passed
        });
        let aim = aims.next().map_or(Aim::Walk, |(aim, _)| *aim);
        let goal = (rng.next_u64() % shape.n_cells() as u64) as usize;
        Self { aim, goal }
    }

    /// Returns the value of each cell in an airspace. `None` means random moves. `target` is the observation with the
    /// highest reward, and `seen` returns all previous sightings.
    pub fn values(
        &self,
        objective: Objective,
        airspace: &Airspace,
        target: usize,
        belief: &Belief,
        seen: impl Fn() -> Sightings,
        rng: &mut ChaCha8Rng,
    ) -> Option<CellValues> {
        match self.aim {
            Aim::Walk => None,
            Aim::Cover => {
                let value = self.value(&seen(), target, rng);
                Some(CellValues::in_sight_of(airspace, value))
            }
            Aim::Far | Aim::Last => {
                let value = self.value(&seen(), target, rng);
                Some(CellValues::new(value, 0.0).within(airspace, None))
            }
            Aim::Exploit { entropy } => {
                let mut values = objective.values_in(belief, airspace);
                if entropy > 0 {
                    let weight = f32::from(entropy) / 10.0;
                    values.add_in_sight(weight, &belief.entropy());
                }
                Some(values)
            }
        }
    }

    fn value(&self, seen: &Sightings, target: usize, rng: &mut ChaCha8Rng) -> Grid<f32> {
        let shape = seen.shape();
        let (height, width) = shape.dim();
        let goal = shape.cell(self.goal);
        let fresh = |age: u32, steps: f32| (-(age as f32) / steps).exp();
        let value = |cell: usize| {
            let noise = (rng.next_u32() >> 8) as f32 / (1 << 24) as f32;
            let last = seen.last(cell);
            let at = shape.cell(cell);
            match self.aim {
                Aim::Far => {
                    let distance = at.row.abs_diff(goal.row) + at.col.abs_diff(goal.col);
                    0.3 * ((height + width - distance) as f32 + noise)
                }
                Aim::Last => {
                    let age = last.map_or(0.0, |(_, age)| fresh(age, FADING_STEPS[1]));
                    let pays = last.is_some_and(|(value, _)| usize::from(value) == target);
                    0.05 * (1.0 - age + noise) + if pays { age } else { 0.0 }
                }
                _ => 1.0 - last.map_or(0.0, |(_, age)| fresh(age, FADING_STEPS[0])),
            }
        };
        let values = (0..shape.n_cells()).map(value).collect();
        Grid::from_shape_vec(shape.dim(), values).expect("invariant: one value per cell")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::Model;
    use emberwatch_model::randomness::{Purpose, stream};

    fn shape() -> Shape {
        Shape::new(3, 4).expect("test shape")
    }

    #[test]
    fn probabilities_sum_to_one_and_behaviours_persist() {
        for stage in [0, 1] {
            let sum: u64 = AIMS.iter().map(|(_, chances)| chances[stage]).sum();
            assert_eq!(sum, 100);
        }
        let mut rng = stream(1, Purpose::Exploration, 0);
        let mut next = |before| Behaviour::next(before, false, shape(), &mut rng);
        let (mut behaviour, mut n_changes) = (next(None), 0);
        for _ in 0..20_000 {
            let before = behaviour;
            behaviour = next(Some(before));
            n_changes += u32::from(behaviour != before);
        }
        // About 1,000 behaviours are drawn, of which 8 % equal the previous behaviour.
        assert!((850..1050).contains(&n_changes), "{n_changes}");
        let drawn: Vec<Aim> = (0..20_000).map(|_| next(None).aim).collect();
        for (aim, chances) in AIMS {
            let share = drawn.iter().filter(|it| **it == aim).count() as f64 / 20_000.0;
            // Five standard deviations of a share of 20,000 draws are at most .018.
            let off = share - chances[1] as f64 / 100.0;
            assert!(off.abs() < 0.018, "{aim:?} {off}");
        }
    }

    #[test]
    fn each_aim_values_its_own_cells_most() {
        let mut seen = Sightings::new(shape());
        let cells = (0..12).filter(|cell| *cell != 7);
        cells.for_each(|cell| seen.see_cell(cell, u8::from(cell == 2)));
        seen.pass();
        let belief = Belief::uniform(2, shape());
        let objective = Objective::new(emberwatch_belief::planning::Target::State(1));
        let open = Airspace::open(shape());
        let values = |aim, airspace: &Airspace| {
            let mut rng = stream(1, Purpose::Exploration, 0);
            let behaviour = Behaviour { aim, goal: 11 };
            let seen = || seen.clone();
            let values = behaviour.values(objective, airspace, 1, &belief, seen, &mut rng);
            values.expect("values")
        };
        for (aim, expected) in [(Aim::Cover, 7), (Aim::Far, 11), (Aim::Last, 2)] {
            let values = values(aim, &open);
            let value = |cell: usize| values.value()[[cell / 4, cell % 4]];
            let best = (0..12).max_by(|&a, &b| value(a).total_cmp(&value(b)));
            assert_eq!(best, Some(expected), "{aim:?}");
        }
        for (entropy, expected) in [(0, 0.5), (3, 0.5 + 0.3 * 2_f32.ln())] {
            let got = values(Aim::Exploit { entropy }, &open).value()[[0, 0]];
            assert!((got - expected).abs() < 1e-6, "{entropy}: {got}");
        }
        // With a wider sensor, coverage and entropy count for all cells in sight.
        let model = Model::wildfire().with_radius(1).expect("a radius");
        let wide = model.airspace(shape()).expect("an airspace");
        let in_sight = |aim| values(aim, &wide).in_sight().is_some();
        assert!(in_sight(Aim::Cover) && in_sight(Aim::Exploit { entropy: 3 }));
        assert!(!in_sight(Aim::Far) && !in_sight(Aim::Exploit { entropy: 0 }));
        assert_eq!(values(Aim::Far, &wide).airspace(), &wide);
    }
}
