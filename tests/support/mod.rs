//! Servers and helpers that the tests share, one module each. The first test that wants a server starts it. It serves the whole test
//! program and ends with it, however that ends.

pub mod apiserver;
pub mod files;
pub mod ministack;
pub mod played;
pub mod player;
pub mod throttle;
pub mod tools;
