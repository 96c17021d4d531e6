"""The thirteen memories in plain PyTorch eager, as one would naturally write them: what popgym-rs's memories are compared with.

Needs only torch, and is no part of the product. `cargo bench -p popgym-models -- --python venv/bin/python` runs it in turns
with the Rust memories (`--serve`); alone it prints a table and writes `--json FILE`.

Input 128 wide, output 256. Elman, LSTM and GRU are `torch.nn`'s; IndRNN, LMU and DNC are Python loops over time of
operators on the whole batch, as POPGym's package has them; FART and FWP are cumulative sums of outer products; S4D is a
convolution by FFT; TCN a convolution. Equations are POPGym 1.0.7's with the DNC's read vectors fed back. Every memory's
number of trainable parameters is checked against POPGym's before anything is timed.

A pass is forward, backward of the mean output (to parameters and input); a step is one time step without gradients on one thread.
"""

import argparse
import json
import math
import statistics
import sys
import time

import torch
import torch.nn.functional as F
from torch import nn

INPUT, HIDDEN = 128, 256
EPISODE = 1024  # After so many steps a state starts anew: some states grow for ever.
# Trainable parameters of POPGym 1.0.7, without IndRNN's and S4D's unused ones.
PARAMETERS = {
    "mlp": 98_816, "pos_mlp": 98_816, "elman": 98_816, "lstm": 395_264, "gru": 296_448, "indrnn": 99_840,
    "dnc": 577_671, "fart": 12_527, "fwp": 13_360, "frame_stack": 139_840, "tcn": 131_328, "lmu": 164_480,
    "s4d": 177_408,
}


def zeros(x, *shape):
    return x.new_zeros(x.shape[0], *shape)


def parameter(*shape, bound=1 / 16):
    return nn.Parameter(torch.empty(shape).uniform_(-bound, bound))


class Memory(nn.Module):
    """`forward`: x [B, T, 128] to [B, T, 256]. `step`: x [B, 128] and a state to [B, 256] and the next state."""

    def start(self, x):
        return ()

    def forward(self, x):
        state, outputs = self.start(x[:, 0]), []
        for t in range(x.shape[1]):
            y, state = self.step(x[:, t], state)
            outputs.append(y)
        return torch.stack(outputs, 1)


class Mlp(Memory):
    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(INPUT, HIDDEN), nn.LeakyReLU(), nn.Linear(HIDDEN, HIDDEN), nn.LeakyReLU())

    def forward(self, x):
        return self.net(x)

    def step(self, x, state):
        return self.net(x), state


class Recurrent(Memory):
    def __init__(self, kind, cell, states=1):
        super().__init__()
        self.rnn, self.cell, self.states = kind(INPUT, HIDDEN, batch_first=True), cell, states

    def forward(self, x):
        return self.rnn(x)[0]

    def start(self, x):
        return tuple(zeros(x, HIDDEN) for _ in range(self.states))

    def step(self, x, state):
        state = state if self.states > 1 else state[0]
        rnn = self.rnn
        new = self.cell(x, state, rnn.weight_ih_l0, rnn.weight_hh_l0, rnn.bias_ih_l0, rnn.bias_hh_l0)
        new = new if self.states > 1 else (new,)
        return new[0], new


class IndRnn(Memory):
    def __init__(self):
        super().__init__()
        self.inputs = nn.ModuleList([nn.Linear(INPUT, HIDDEN), nn.Linear(HIDDEN, HIDDEN)])
        self.weight = nn.ParameterList([nn.Parameter(torch.rand(HIDDEN)) for _ in range(2)])
        self.bias = nn.ParameterList([nn.Parameter(torch.rand(HIDDEN)) for _ in range(2)])
        self.limit = 2 ** (1 / 1024)

    def start(self, x):
        # Recurrent weights are clamped before every forward.
        with torch.no_grad():
            for weight in self.weight:
                weight.clamp_(-self.limit, self.limit)
        return (zeros(x, HIDDEN), zeros(x, HIDDEN))

    def step(self, x, state):
        new = []
        for layer, before, weight, bias in zip(self.inputs, state, self.weight, self.bias):
            x = torch.relu(layer(x) + before * weight + bias)
            new.append(x)
        return x, tuple(new)


class Lmu(Memory):
    def __init__(self, theta=64.0):
        super().__init__()
        i = torch.arange(HIDDEN, dtype=torch.float64)[:, None]
        j = i.T
        a = (2 * i + 1) / theta * torch.where(i < j, -1.0, (-1.0) ** (i - j + 1))
        b = (2 * i + 1) / theta * (-1.0) ** i
        discrete = torch.matrix_exp(a)
        self.register_buffer("a", discrete.float())
        self.register_buffer("b", torch.linalg.solve(a, (discrete - torch.eye(HIDDEN, dtype=torch.float64)) @ b)[:, 0].float())
        self.encode = nn.ParameterList(
            [parameter(1, INPUT), parameter(1, HIDDEN), nn.Parameter(torch.zeros(1, HIDDEN))])
        self.kernel = nn.ParameterList([parameter(HIDDEN, INPUT), parameter(HIDDEN, HIDDEN), parameter(HIDDEN, HIDDEN)])

    def start(self, x):
        return (zeros(x, HIDDEN), zeros(x, HIDDEN))

    def step(self, x, state):
        h, m = state
        u = F.linear(x, self.encode[0]) + F.linear(h, self.encode[1]) + F.linear(m, self.encode[2])
        m = F.linear(m, self.a) + u * self.b
        h = torch.tanh(F.linear(x, self.kernel[0]) + F.linear(h, self.kernel[1]) + F.linear(m, self.kernel[2]))
        return h, (h, m)


class FastWeights(Memory):
    """What FART and FWP share: normalised input, keys, queries, values, and the tail."""

    def __init__(self, width):
        super().__init__()
        self.width = width
        self.norm = nn.LayerNorm(INPUT)
        self.key, self.query, self.value = (nn.Linear(INPUT, width, bias=False) for _ in range(3))
        self.feed = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.shortcut, self.out = nn.Linear(INPUT, width), nn.Linear(width, HIDDEN)

    def tail(self, o, x):
        return self.out(self.feed(o) + self.shortcut(x))


class Fart(FastWeights):
    def __init__(self):
        super().__init__(15)

    def terms(self, x):
        x = self.norm(x)
        k, q, v = F.elu(self.key(x)) + 1, F.elu(self.query(x)) + 1, self.value(x)
        return x, q, k, k.unsqueeze(-1) * v.unsqueeze(-2)

    def read(self, x, q, z, s):
        o = torch.einsum("...i,...ij->...j", q, s) / ((q * z).sum(-1, keepdim=True) + 1e-5)
        return self.tail(o, x)

    def forward(self, x):
        x, q, k, kv = self.terms(x)
        return self.read(x, q, k.cumsum(1), kv.cumsum(1))

    def start(self, x):
        return (zeros(x, self.width), zeros(x, self.width, self.width))

    def step(self, x, state):
        x, q, k, kv = self.terms(x)
        z, s = state[0] + k, state[1] + kv
        return self.read(x, q, z, s), (z, s)


class Fwp(FastWeights):
    def __init__(self):
        super().__init__(16)

    def terms(self, x):
        x = self.norm(x)
        k, q, v = torch.relu(self.key(x)), torch.relu(self.query(x)), self.value(x)
        k, q = (a / (1e-5 + a.sum(-1, keepdim=True)) for a in (k, q))
        return x, q, v.unsqueeze(-1) * k.unsqueeze(-2)

    def read(self, x, q, s):
        return self.tail(torch.einsum("...ij,...j->...i", s, q), x)

    def forward(self, x):
        x, q, vk = self.terms(x)
        return self.read(x, q, vk.cumsum(1))

    def start(self, x):
        return (zeros(x, self.width, self.width),)

    def step(self, x, state):
        x, q, vk = self.terms(x)
        s = state[0] + vk
        return self.read(x, q, s), (s,)


class FrameStack(Memory):
    def __init__(self):
        super().__init__()
        self.frame = nn.Linear(INPUT, 64)
        self.net = nn.Sequential(nn.Linear(256, HIDDEN), nn.LeakyReLU(), nn.Linear(HIDDEN, HIDDEN), nn.LeakyReLU())

    def forward(self, x):
        steps = x.shape[1]
        frames = self.frame(F.pad(x, (0, 0, 3, 0)))
        return self.net(torch.cat([frames[:, i:i + steps] for i in range(4)], -1))

    def start(self, x):
        return (zeros(x, 3, INPUT),)

    def step(self, x, state):
        window = torch.cat([state[0], x[:, None]], 1)
        return self.net(self.frame(window).flatten(1)), (window[:, 1:],)


class Tcn(Memory):
    def __init__(self):
        super().__init__()
        self.conv = nn.Conv1d(INPUT, HIDDEN, 4)

    def forward(self, x):
        return self.conv(F.pad(x.transpose(1, 2), (3, 0))).transpose(1, 2)

    def start(self, x):
        return (zeros(x, 3, INPUT),)

    def step(self, x, state):
        window = torch.cat([state[0], x[:, None]], 1)
        return self.conv(window.transpose(1, 2))[:, :, 0], (window[:, 1:],)


class S4d(Memory):
    def __init__(self, modes=8):
        super().__init__()
        self.input, self.output = nn.Linear(INPUT, HIDDEN), nn.Linear(HIDDEN, 2 * HIDDEN)
        self.log_decay = nn.Parameter(torch.full((HIDDEN, modes), math.log(0.5)))
        self.frequency = nn.Parameter(math.pi * torch.arange(modes).float().repeat(HIDDEN, 1))
        self.b = nn.Parameter(torch.view_as_real(torch.ones(HIDDEN, modes, dtype=torch.cfloat)).clone())
        self.c = nn.Parameter(torch.view_as_real(torch.randn(HIDDEN, modes, dtype=torch.cfloat)).clone())
        self.d = nn.Parameter(torch.randn(HIDDEN))
        self.log_dt = nn.Parameter(torch.empty(HIDDEN).uniform_(math.log(0.001), math.log(0.1)))

    def discretised(self):
        a = torch.complex(-self.log_decay.exp(), self.frequency)
        adt = a * self.log_dt.exp()[:, None]
        return adt, torch.view_as_complex(self.b) * (adt.exp() - 1) / a

    def tail(self, y):
        return F.glu(self.output(F.gelu(y)), -1)

    def forward(self, x):
        steps, u = x.shape[1], self.input(x).transpose(1, 2)
        adt, b = self.discretised()
        powers = torch.exp(adt[:, :, None] * torch.arange(steps, device=x.device))
        kernel = 2 * torch.einsum("hn,hnl->hl", torch.view_as_complex(self.c) * b, powers).real
        spectrum = torch.fft.rfft(u, n=2 * steps) * torch.fft.rfft(kernel, n=2 * steps)
        y = torch.fft.irfft(spectrum, n=2 * steps)[..., :steps] + self.d[:, None] * u
        return self.tail(y.transpose(1, 2))

    def start(self, x):
        # Beside the state, what an actor computes once for its weights.
        adt, b = self.discretised()
        return (zeros(x, *self.b.shape[:2]).to(torch.cfloat), adt.exp(), b)

    def step(self, x, state):
        s, a, b = state
        u = self.input(x)
        s = a * s + b * u.unsqueeze(-1)
        y = 2 * (torch.view_as_complex(self.c) * s).sum(-1).real + self.d * u
        return self.tail(y), (s, a, b)


class Dnc(Memory):
    def __init__(self, cells=16, width=16, heads=4):
        super().__init__()
        self.cells, self.width, self.heads = cells, width, heads
        self.lstm = nn.LSTMCell(INPUT + heads * width, HIDDEN)
        # Read keys and strengths, write key and strength, erase, write vector, free gates, two gates, read modes.
        self.parts = [heads * width, heads, width, 1, width, width, heads, 1, 1, 3 * heads]
        self.interface = nn.Linear(HIDDEN, sum(self.parts))
        self.out = nn.Linear(HIDDEN + heads * width, HIDDEN)

    def start(self, x):
        n, w, r = self.cells, self.width, self.heads
        return tuple(zeros(x, *shape) for shape in [(HIDDEN,), (HIDDEN,), (r * w,), (n, w), (n, n), (n,), (r, n), (n,), (n,)])

    def content(self, memory, key, strength):
        norms = memory.norm(dim=-1)[:, None] * key.norm(dim=-1)[:, :, None] + 1e-6
        return torch.softmax(strength.unsqueeze(-1) * (key @ memory.transpose(1, 2)) / norms, -1)

    def allocation(self, usage):
        ordered, order = (1e-6 + (1 - 1e-6) * usage).sort(-1)
        before = torch.cumprod(torch.cat([torch.ones_like(ordered[:, :1]), ordered[:, :-1]], -1), -1)
        return torch.zeros_like(usage).scatter(1, order, (1 - ordered) * before)

    def step(self, x, state):
        h, c, read, memory, link, precedence, read_weights, write_weights, usage = state
        h, c = self.lstm(torch.cat([x, read], -1), (h, c))
        g = h.clamp(-20, 20)
        parts = self.interface(g).split(self.parts, -1)
        read_key = torch.tanh(parts[0]).unflatten(1, (self.heads, self.width))
        read_strength, write_strength = F.softplus(parts[1]), F.softplus(parts[3])
        write_key, write_vector = torch.tanh(parts[2]), torch.tanh(parts[5])
        erase, free, allocation_gate, write_gate = (torch.sigmoid(parts[i]) for i in (4, 6, 7, 8))
        modes = torch.softmax(parts[9].unflatten(1, (self.heads, 3)), -1)

        usage = usage + (1 - usage) * write_weights
        usage = usage * torch.prod(1 - free.unsqueeze(-1) * read_weights, 1)
        content = self.content(memory, write_key[:, None], write_strength)[:, 0]
        w = write_gate * (allocation_gate * self.allocation(usage) + (1 - allocation_gate) * content)
        memory = memory * (1 - w.unsqueeze(-1) * erase[:, None]) + w.unsqueeze(-1) * write_vector[:, None]
        link = (1 - w.unsqueeze(-1) - w[:, None]) * link + w.unsqueeze(-1) * precedence[:, None]
        link = link * (1 - torch.eye(self.cells, device=x.device))
        precedence = (1 - w.sum(-1, keepdim=True)) * precedence + w

        # Row r, cell i: sum over j of L_ij wr_j is forward, of L_ji wr_j backward.
        forward, backward = read_weights @ link.transpose(1, 2), read_weights @ link
        content = self.content(memory, read_key, read_strength)
        read_weights = modes[..., :1] * backward + modes[..., 1:2] * forward + modes[..., 2:] * content
        read = (read_weights @ memory).flatten(1)
        y = self.out(torch.cat([g, read], -1))
        return y, (h, c, read, memory, link, precedence, read_weights, w, usage)


KINDS = {
    "mlp": Mlp,
    "pos_mlp": Mlp,
    "elman": lambda: Recurrent(nn.RNN, torch.rnn_tanh_cell),
    "lstm": lambda: Recurrent(nn.LSTM, torch.lstm_cell, states=2),
    "gru": lambda: Recurrent(nn.GRU, torch.gru_cell),
    "indrnn": IndRnn,
    "dnc": Dnc,
    "fart": Fart,
    "fwp": Fwp,
    "frame_stack": FrameStack,
    "tcn": Tcn,
    "lmu": Lmu,
    "s4d": S4d,
}


class Bench:
    """Times one memory at a time."""

    def __init__(self, device, threads):
        self.device, self.threads, self.name, self.memory = torch.device(device), threads, None, None

    def use(self, name):
        if name != self.name:
            self.name, self.memory = name, KINDS[name]().to(self.device)
            count = sum(p.numel() for p in self.memory.parameters())
            assert count == PARAMETERS[name], f"{name} has {count} parameters, POPGym's {PARAMETERS[name]}"

    def now(self):
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def passes(self, sequences, steps, seconds):
        """Seconds of each pass, over `seconds` and at least one."""
        torch.set_num_threads(self.threads)
        x = torch.randn(sequences, steps, INPUT, device=self.device)
        times, begun = [], self.now()
        while not times or self.now() - begun < seconds:
            self.memory.zero_grad()
            start = self.now()
            self.memory(x.detach().requires_grad_()).mean().backward()
            times.append(self.now() - start)
        return times

    @torch.no_grad()
    def steps(self, rows, seconds):
        """Seconds of each step: means over up to an episode, over `seconds` and at least one."""
        torch.set_num_threads(1)
        x = torch.randn(rows, INPUT, device=self.device)
        times, begun = [], self.now()
        while not times or self.now() - begun < seconds:
            state, start, count = self.memory.start(x), self.now(), 0
            while count == 0 or count < EPISODE and (count % 16 or time.perf_counter() - start < seconds):
                _, state = self.memory.step(x, state)
                count += 1
            times.append((self.now() - start) / count)
        return times


def check(name):
    """The two forms are one function."""
    torch.manual_seed(0)
    memory, x = KINDS[name](), torch.randn(3, 70, INPUT)
    with torch.no_grad():
        whole, steps = memory(x), Memory.forward(memory, x)
    difference = (whole - steps).abs().max().item()
    assert difference <= 1e-4 * max(1.0, steps.abs().max().item()), f"{name}: forms differ by {difference}"
    return difference


def serve(bench):
    """Answers requests, one line of JSON each, until the input ends."""
    for line in sys.stdin:
        request = json.loads(line)
        bench.use(request["memory"])
        assert request["parameters"] == PARAMETERS[request["memory"]], f"not the same work: {request}"
        if "rows" in request:
            times = bench.steps(request["rows"], request["seconds"])
        else:
            times = bench.passes(request["sequences"], request["steps"], request["seconds"])
        print(json.dumps({"seconds": statistics.median(times), "count": len(times)}), flush=True)


def report(bench, arguments):
    """All figures, as a table and as JSON."""
    figures = []
    for name in arguments.memories:
        bench.use(name)
        for sequences, steps in arguments.shapes:
            bench.passes(sequences, steps, 0)
            times = bench.passes(sequences, steps, arguments.seconds)
            figures.append({"memory": name, "sequences": sequences, "steps": steps, "seconds": statistics.median(times), "samples": times})
            print(f"| {name} | {sequences}x{steps} | {figures[-1]['seconds'] * 1e3:.2f} ms |", flush=True)
        for rows in arguments.rows:
            bench.steps(rows, 0.01)
            times = bench.steps(rows, arguments.seconds)
            figures.append({"memory": name, "rows": rows, "seconds": statistics.median(times), "samples": times})
            print(f"| {name} | {rows} rows | {figures[-1]['seconds'] * 1e6:.1f} us |", flush=True)
    if arguments.json:
        with open(arguments.json, "w") as file:
            about = {"torch": torch.__version__, "device": arguments.device, "threads": arguments.threads}
            json.dump({**about, "figures": figures}, file, indent=1)


def listed(parse):
    return lambda text: [parse(part) for part in text.split(",")]


def shape(text):
    sequences, steps = text.split("x")
    return int(sequences), int(steps)


def known(name):
    if name not in KINDS:
        raise ValueError(name)
    return name


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--memories", type=listed(known), default=list(KINDS), help="names, with commas")
    parser.add_argument("--shapes", type=listed(shape), default=[(158, 52), (8, 1023), (64, 1024)], help="SEQUENCESxSTEPS, with commas")
    parser.add_argument("--rows", type=listed(int), default=[1, 64, 256], help="rows of one step, with commas")
    parser.add_argument("--seconds", type=float, default=2.0, help="time of each figure")
    parser.add_argument("--threads", type=int, default=2, help="threads of a pass; a step has one")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--json", help="file for all figures")
    parser.add_argument("--serve", action="store_true", help="answer requests on the standard input")
    parser.add_argument("--check", action="store_true", help="only check parameter counts, and that both forms agree")
    arguments = parser.parse_args()
    bench = Bench(arguments.device, arguments.threads)
    if arguments.check:
        for name in arguments.memories:
            bench.use(name)
            print(f"{name}: {PARAMETERS[name]} parameters, forms differ by {check(name):.1e}")
    elif arguments.serve:
        serve(bench)
    else:
        report(bench, arguments)


if __name__ == "__main__":
    main()
