//! Tables and properties of `decide`, by stage of life. Every pass of every table also obeys `rules`.

mod accept;
mod after;
mod allowance;
mod blame;
mod builders;
mod crashes;
mod end;
mod failure;
mod finalizer;
mod image;
mod isolation;
mod line;
mod log;
mod nodes;
mod properties;
mod reading;
mod resume;
mod retention;
mod rules;
mod run;
mod start;
mod stop;
