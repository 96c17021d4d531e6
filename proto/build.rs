//! Generates the wire types and the gRPC service from `proto/popgym.proto`, without a `protoc` on the machine.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed=proto/popgym.proto");
    let descriptors = protox::compile(["popgym.proto"], ["proto"])?;
    // `bytes` fields are `bytes::Bytes`: weights are shared by all streams, and episodes are not copied on arrival.
    tonic_prost_build::configure().bytes(".").compile_fds(descriptors)?;
    Ok(())
}
