//! `popgym_fuzz::wire` for libFuzzer.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    popgym_fuzz::wire(data);
});
