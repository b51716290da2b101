//! Every decoder, ten thousand hostile inputs each. A process of its own, as it watches its memory.

use tests::fuzz::TARGETS;
use tests::fuzz::campaign::Campaign;

#[test]
fn every_decoder_stands_ten_thousand_inputs() {
    for target in TARGETS {
        let campaign = Campaign::new(target, 1).expect("its corpus");
        let report = campaign
            .run(10_000)
            .unwrap_or_else(|failure| panic!("{failure}"));
        let share = report.n_accepted * 100 / report.n_inputs;
        let name = target.name;
        assert!((1..100).contains(&share), "{name}: {share} % accepted");
    }
}
