# %% [markdown]
# # The active loop beside the exact limit
#
# The numerical model of Kim & Matsubara (2025) has two parameters, and its posterior
# can be computed: $x = \theta_1 e^{3 - \xi} + \theta_2\, \xi + \varepsilon$. So
# whatever the loop says can be compared with the right answer: the belief, and the
# information that an action gives.
#
# Reduced sizes: one campaign of three trials. The full comparison, 60 campaigns, stands
# in [what was measured](../benchmarks.md).

# %%
import torch

from sbi_active import Campaign
from sbi_active.tasks import get_task

task = get_task("numerical")
campaign = Campaign(task.simulator, task.prior, task.actions, seed=0)
campaign.run(task.real_system, num_rounds=3)
table = campaign.to_dataframe()
table[[c for c in table.columns if c.startswith(("action", "expected", "inform"))]]

# %% [markdown]
# The exact posterior of the same trials:

# %%
actions = torch.stack([trial.action for trial in campaign.history])
outcomes = torch.stack([trial.x for trial in campaign.history])
exact = task.reference(actions, outcomes)
belief = campaign.belief
draws = belief.sample((4_000,))
divergence = (belief.log_prob(draws) - exact.log_prob(draws)).mean()
print(
    f"log p(truth): {float(belief.log_prob(task.theta_true)):.2f} nats here, "
    f"{float(exact.log_prob(task.theta_true[None])):.2f} exactly"
)
print(f"KL(belief | exact posterior): {float(divergence):.3f} nats")

# %% [markdown]
# And the information of each action. The exact gain of the first trial is that of the
# prior:

# %%
import matplotlib.pyplot as plt

first = campaign.history[0].design
nothing = task.reference(actions[:0], outcomes[:0])
gain = nothing.expected_information_gain(task.actions.values)
gain = gain[0] if isinstance(gain, tuple) else gain
figure, ax = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
first.plot(ax)
ax.plot(task.actions.values[:, 0], gain, color="C1", label="exact")
ax.set(title="what the first trial tells")
_ = ax.legend()

# %% [markdown]
# Where candidates far behind were dropped early, their estimates are rough: a design
# spends its simulations on those that may be the best.
#
# The command line does the same and draws figure 3 of the paper:
#
# ```bash
# sbi-active run numerical --method asbi --rounds 4 --seed 0 --out demo
# ```
