use popgym_envs::Space;
use popgym_models::memory::*;
use popgym_models::*;
use tch::nn::{Init, Path};
use tch::{Device, Kind, Tensor};
struct Base([Tensor; 4]);
impl MemoryKind for Base {
    const NAME: &'static str = "base";
    const PAPER_NAME: &'static str = "base";
    type Options = toml::Table;
    fn new(p: &Path<'_>, n: i64, _: &toml::Table) -> Result<Self, String> {
        let i = Init::Uniform { lo: -1.0 / 16.0, up: 1.0 / 16.0 };
        Ok(Self([
            p.var("weight_input", &[768, n], i),
            p.var("weight_state", &[768, 256], i),
            p.var("bias_input", &[768], i),
            p.var("bias_state", &[768], i),
        ]))
    }
}
impl Memory for Base {
    fn output_width(&self) -> i64 {
        256
    }
    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, 256], (Kind::Float, device))])
    }
    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let [a, b, c, d] = &self.0;
        let n = input.gru_cell(&state.0[0], a, b, Some(c), Some(d));
        (n.shallow_clone(), State(vec![n]))
    }
    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        let (output, last) = Tensor::gru_data(
            input,
            &packing.batch_sizes_tensor(),
            &state.0[0].unsqueeze(0),
            &self.0,
            true,
            1,
            0.0,
            true,
            false,
        );
        Scan { output, state: State(vec![last.squeeze_dim(0)]), computed_steps: packing.rows(), backward: None }
    }
}
fn main() {
    let mut reg = memory::Registry::standard();
    reg.register::<Base>();
    let policies: Vec<Policy> = ["base", "gru"]
        .iter()
        .map(|m| {
            let spec = PolicySpec {
                observation: Space::Discrete(4),
                action: Space::Discrete(4),
                memory: m.to_string(),
                memory_options: toml::Table::new(),
                options: PolicyOptions { log_std_min: f64::NEG_INFINITY, log_std_max: f64::INFINITY },
            };
            Policy::new(&spec, &reg, Device::Cpu).unwrap()
        })
        .collect();
    let reps: usize = std::env::args().nth(1).map_or(6, |s| s.parse().unwrap());
    for threads in [1, 2] {
        device::set_threads(threads);
        for (b, t) in [(20i64, 51i64), (8, 200), (160, 51)] {
            let packing = Packing::new(&vec![t; b as usize]);
            let x = Tensor::rand([packing.rows(), policies[0].encoder().width() as i64], (Kind::Float, Device::Cpu));
            let mut best = [[f64::MAX; 3]; 2];
            for _ in 0..reps {
                for (p, best) in policies.iter().zip(&mut best) {
                    for _ in 0..2 {
                        let t0 = std::time::Instant::now();
                        let out = p.scan(&x, &packing, 0);
                        let f = t0.elapsed().as_secs_f64();
                        let loss = out.params.square().mean(Kind::Float) + out.values.square().mean(Kind::Float);
                        out.backward(&loss);
                        let all = t0.elapsed().as_secs_f64();
                        let t0 = std::time::Instant::now();
                        tch::no_grad(|| p.scan(&x, &packing, 0));
                        let ng = t0.elapsed().as_secs_f64();
                        for (b, v) in best.iter_mut().zip([f, all, ng]) {
                            *b = b.min(v);
                        }
                    }
                }
            }
            let rows = packing.rows() as f64;
            for (n, b) in ["base", "gru "].iter().zip(best) {
                println!(
                    "threads {threads} B={b0} T={t} {n}: fwd {:.2} ms, fwd+bwd {:.2} ms = {:.0} passes/s, nograd fwd {:.2} ms",
                    b[0] * 1e3,
                    b[1] * 1e3,
                    rows / b[1],
                    b[2] * 1e3,
                    b0 = rows as i64 / t
                );
            }
        }
        for rows in [16, 64, 128, 256] {
            let x = Tensor::rand([rows, policies[0].encoder().width() as i64], (Kind::Float, Device::Cpu));
            let mut best = [f64::MAX; 2];
            for _ in 0..reps * 4 {
                for (p, best) in policies.iter().zip(&mut best) {
                    let mut s = p.initial_state(rows);
                    for _ in 0..10 {
                        let t0 = std::time::Instant::now();
                        s = p.act(&x, &s).1;
                        *best = best.min(t0.elapsed().as_secs_f64());
                    }
                }
            }
            println!("threads {threads} act B={rows}: base {:.0} us, gru {:.0} us", best[0] * 1e6, best[1] * 1e6);
        }
    }
}
