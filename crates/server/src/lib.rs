//! The server half: everything `taskd` does. Imports run downward only; see ARCHITECTURE.md.
