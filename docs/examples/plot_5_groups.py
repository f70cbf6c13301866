"""
Two groups, and what is a unit
==============================

The unit is whatever the treatment was assigned to: a cage, where whole cages were treated; an
animal, where a cage holds both groups. Sessions and bouts are never units. A study without any
effect shows why.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from liex_lab.behaviour.cohort import compare, counted_units

rng = np.random.default_rng(4)
rows = []
for cage in range(12):
    cage_mean = rng.normal(8.0, 1.0)
    for animal in range(2):
        animal_mean = cage_mean + rng.normal(0.0, 0.5)
        for _ in range(3):
            rows.append(
                {
                    "session_id": f"s{len(rows):03d}",
                    "subject_id": f"m{cage}{animal}",
                    "cage": f"c{cage}",
                    "group": "drug" if cage >= 6 else "vehicle",
                    "distance_m": animal_mean + rng.normal(0.0, 0.3),
                }
            )
table = pd.DataFrame(rows)

# %%
# 72 sessions of 24 animals in 12 cages, 6 cages in each group, and no effect. This is what
# ``liex compare`` does with the sessions of a folder:
found = compare(table, ["distance_m"]).iloc[0]
print(f"{found.contrast}: {found.estimate:.2f} m [{found.ci_low:.2f}, {found.ci_high:.2f}]")
print(f"p {found.p:.2f}, {found.test}; {counted_units(found)}")

# %%
# With two cages in each group no arrangement of cages can reach 5 per cent, and no test is made;
# the difference is shown all the same.
few = compare(table[table.cage.isin(["c0", "c1", "c10", "c11"])], ["distance_m"]).iloc[0]
print(f"{few.estimate:.2f} m; no test: {few.refused}")

# %%
# Every animal drawn, cages side by side:
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
animals = table.groupby(["group", "cage", "subject_id"], sort=False).distance_m.mean().reset_index()
for k, cage in enumerate(animals.cage.unique()):
    own = animals[animals.cage == cage]
    colour = "#D55E00" if own.group.iloc[0] == "drug" else "#0072B2"
    axis.plot(np.full(len(own), k), own.distance_m, "o-", color=colour)
axis.set(xlabel="cage (blue: vehicle, orange: drug)", ylabel="distance (m)", xticks=[])
plt.show()
