//! Sentences: each failure has its own, with a next step that a retry leaves out.

use crate::api::reasons;
use crate::controller::decide::failure::{infrastructure, invalid_results, participant, what_happened};
use crate::text::sentence;

#[test]
fn a_next_step_is_added_and_taken_off_again() {
    for reason in [
        reasons::NODE_LOST,
        reasons::SIMULATION_CRASHED,
        reasons::JOB_FAILED,
        reasons::IMAGE_PULL,
    ] {
        let failure = infrastructure(reason, "It broke.");
        assert!(failure.message.len() > "It broke. ".len(), "{reason}");
        assert_eq!(what_happened(&failure), "It broke.");
    }
    assert_eq!(
        infrastructure(reasons::PREFIX_IN_USE, "Taken. Empty it.").message,
        "Taken. Empty it."
    );
    assert_eq!(
        what_happened(&participant(reasons::IDLE, "Slow. Hurry.")),
        "Slow. Hurry."
    );
}

#[test]
fn words_become_one_sentence() {
    for (words, wanted) in [("no", "no."), (" no. ", "no."), ("cut …", "cut …"), ("", "")] {
        assert_eq!(sentence(words), wanted);
    }
    assert!(!invalid_results("a score of NaN.").message.contains(".."));
}
