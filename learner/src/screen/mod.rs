//! Environments on a terminal and as animated images.
//!
//! | module | what it holds |
//! |---|---|
//! | [`app`] | the loop of a program on the terminal |
//! | [`terminal`], [`signals`], [`key`] | the terminal, taken and given back; signals meanwhile; what was pressed |
//! | [`layout`], [`panel`] | where pictures and text stand; the text beside a picture |
//! | [`controls`], [`places`], [`joint`] | from keys to actions; the places of a picture that stand for actions |
//! | [`game`], [`player`] | one environment being played; by a person |
//! | [`agent`], [`spectator`] | a trained policy that acts; watched |
//! | [`animation`], [`font`] | animated GIFs; characters as pixels |

pub(crate) mod agent;
pub(crate) mod animation;
pub(crate) mod app;
pub(crate) mod controls;
pub(crate) mod font;
pub(crate) mod game;
pub(crate) mod joint;
pub(crate) mod key;
pub(crate) mod layout;
pub(crate) mod panel;
pub(crate) mod places;
pub(crate) mod player;
pub(crate) mod signals;
pub(crate) mod spectator;
pub(crate) mod terminal;
