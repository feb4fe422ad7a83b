//! The mechanics as a whole, in this process: the paper's numbers, and what a step costs in instructions and in memory.

mod alloc;
mod callgrind;
mod closed_loop;
mod reference;
mod registers;
