//! Reports: a batch read and written at a time.
