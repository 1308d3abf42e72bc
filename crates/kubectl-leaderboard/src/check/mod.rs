//! `check`: what one route with one pair shows of every part of a Leaderboard.
//!
//! `parts` turns the objects into findings (`finding`), `table` prints them, `plan` makes the Submission, `give_up` decides when waiting is
//! over, `readers` asks who else reads the queue, `collectors` who else stores the lines. All but what these two ask is pure.

mod collectors;
mod finding;
mod give_up;
mod parts;
mod plan;
mod readers;
mod table;

#[cfg(test)]
pub use collectors::Collector;
pub use collectors::{Collectors, ask as ask_for_collectors};
#[cfg(test)]
pub use finding::{Mark, Part};
pub use give_up::Patience;
pub use parts::{Seen, findings};
pub use plan::{Wanted, submission, which};
#[cfg(test)]
pub use readers::Reader;
pub use readers::{Readers, ask as ask_for_readers};
pub use table::{Outcome, begun, kept, left, lines};
