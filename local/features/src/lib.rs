//! Has no code: its dependencies ask for features.
