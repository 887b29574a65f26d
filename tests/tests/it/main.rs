//! End-to-end tests against the real server process, one module for each subject. One program, because each would be linked with everything else.

mod bad_input;
mod cli;
mod control;
mod demo;
mod depth;
mod detect;
mod drain;
mod faults;
mod hanging;
mod health;
mod limits;
mod listen;
mod metrics;
mod overload;
mod property;
mod provider;
mod python;
mod readme;
mod reload;
mod replay;
mod replicas;
mod rest;
mod security;
mod traces;
mod track;
mod workspaces;
