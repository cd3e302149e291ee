"""The flow of modalwatch in PyTorch, timed: python3 benches/peers/flow.py [THREADS]. Prints one `name value` a line.

Same sizes as the default: 3 parameters, 3 modes, 4 units of two subnets of width 64, SiLU, 16 convolution channels, 32
features, batch 256, AdamW. Times in milliseconds a training step, rates in million draws a second.
"""

import sys
import time

import torch
from torch import nn

PARAMETERS, MODES, UNITS, WIDTH, CHANNELS, FEATURES, BATCH, CLAMP = 3, 3, 4, 64, 16, 32, 256, 3.0


class Subnet(nn.Module):
    def __init__(self, inputs, active):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(inputs, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU(), nn.Linear(WIDTH, 2 * active)
        )

    def forward(self, passive, context):
        scale, shift = self.layers(torch.cat([passive, context], 1)).chunk(2, 1)
        return CLAMP * torch.tanh(scale / CLAMP), shift


class Flow(nn.Module):
    def __init__(self):
        super().__init__()
        first = PARAMETERS // 2
        self.sizes = [first, PARAMETERS - first]
        context = FEATURES + MODES
        self.convolutions = nn.Sequential(
            nn.Conv1d(1, CHANNELS, 3, padding=1), nn.SiLU(), nn.Conv1d(CHANNELS, CHANNELS, 3, padding=1), nn.SiLU()
        )
        self.features = nn.Sequential(nn.Linear(MODES * CHANNELS, FEATURES), nn.SiLU())
        self.on_second = nn.ModuleList(Subnet(first + context, PARAMETERS - first) for _ in range(UNITS))
        self.on_first = nn.ModuleList(Subnet(PARAMETERS - first + context, first) for _ in range(UNITS))
        self.orders = [torch.randperm(PARAMETERS) for _ in range(UNITS)]

    def summarise(self, y):
        return torch.cat([self.features(self.convolutions(y).flatten(1)), y.flatten(1)], 1)

    def loss(self, x, y):
        context = self.summarise(y)
        log_det = 0.0
        for order, on_second, on_first in zip(self.orders, self.on_second, self.on_first):
            x1, x2 = x[:, order].split(self.sizes, 1)
            scale, shift = on_second(x1, context)
            x2 = x2 * scale.exp() + shift
            log_det = log_det + scale.sum(1)
            scale, shift = on_first(x2, context)
            x1 = x1 * scale.exp() + shift
            log_det = log_det + scale.sum(1)
            x = torch.cat([x1, x2], 1)
        return (0.5 * x.square().sum(1) - log_det).mean()

    def inverse(self, z, context):
        for order, on_second, on_first in zip(self.orders[::-1], self.on_second.__reversed__(), self.on_first.__reversed__()):
            z1, z2 = z.split(self.sizes, 1)
            scale, shift = on_first(z2, context)
            z1 = (z1 - shift) * (-scale).exp()
            scale, shift = on_second(z1, context)
            z2 = (z2 - shift) * (-scale).exp()
            z = torch.cat([z1, z2], 1)[:, torch.argsort(order)]
        return z


def milliseconds(work, warm=30, rounds=15, at_a_time=20):
    for _ in range(warm):
        work()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(at_a_time):
            work()
        times.append((time.perf_counter() - start) / at_a_time)
    return 1e3 * sorted(times)[rounds // 2]


def main():
    torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
    torch.manual_seed(1)
    x, y = torch.randn(BATCH, PARAMETERS), torch.randn(BATCH, 1, MODES)
    print("torch", torch.__version__)
    for name, compiled in [("eager", False), ("compiled", True)]:
        flow = Flow()
        try:
            loss_of = torch.compile(flow.loss) if compiled else flow.loss
            optimiser = torch.optim.AdamW(flow.parameters(), lr=1e-4, fused=compiled)

            def step():
                optimiser.zero_grad(set_to_none=True)
                loss_of(x, y).backward()
                optimiser.step()

            print(f"step_{name}_ms", round(milliseconds(step), 3))
        except Exception as error:  # No C++ compiler, or a version that cannot: said, not hidden.
            print(f"step_{name}_failed", type(error).__name__)
    draws, flow = 50_000, Flow().eval()
    with torch.inference_mode():
        context = flow.summarise(torch.randn(50, 1, MODES)).repeat_interleave(draws // 50, 0)
        took = milliseconds(lambda: flow.inverse(torch.randn(draws, PARAMETERS), context), warm=2, rounds=7, at_a_time=1)
    print("bulk_million_per_s", round(draws / took / 1e3, 3))


main()
