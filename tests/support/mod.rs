//! What the tests share, one module for each thing that a test starts. Each is started by the first test that wants it,
//! serves the whole test program and ends with it, however that ends.

pub mod apiserver;
pub mod files;
pub mod ministack;
pub mod played;
pub mod player;
pub mod throttle;
pub mod tools;
