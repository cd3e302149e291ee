// Dialog that describes a new structure: a structure file from a template, checked by the service before it is stored.

import { request } from "../api.js";
import { ask, h, notify } from "../dom.js";

const BUILDING = `# A building of three storeys: each mass is a floor, each spring the columns of a storey.
id = "my-building"
description = "Building of three storeys, north-south direction"
modes = 3                                  # the lowest three frequencies are measured
measurement_noise = { relative = 0.002 }   # standard deviation of one measured frequency, relative

mass = [
    { name = "floor1", kg = 60000.0 },
    { name = "floor2", kg = 60000.0 },
    { name = "roof", kg = 45000.0 },
]
spring = [
    { name = "storey1", from = "ground", to = "floor1", n_per_m = 9.0e7 },
    { name = "storey2", from = "floor1", to = "floor2", n_per_m = 8.0e7 },
    { name = "storey3", from = "floor2", to = "roof", n_per_m = 7.0e7 },
]

# What is unknown: a factor of the nominal stiffness (scale = true). The prior is the range in which it can lie, damaged or not:
# here 0.5 to 1.4 times n_per_m. Results are in per cent of the nominal stiffness. Where you know a mean and a standard deviation
# instead: prior = { normal = { mean = 1.0, std = 0.1 } }, or { log_normal = { median = 1.0, relative_std = 0.2 } }, which is above 0.
[[parameter]]
name = "storey1"
scale = true
prior = { uniform = [0.5, 1.4] }
sets = { spring = "storey1" }

[[parameter]]
name = "storey2"
scale = true
prior = { uniform = [0.5, 1.4] }
sets = { spring = "storey2" }

# What is noted beside the frequencies.
[[covariate]]
name = "temperature"
unit = "°C"
`;

const BRIDGE = `# A bridge of two spans with an elastic bearing on the pier.
id = "my-bridge"
description = "Bridge of two spans, vertical bending"
simulation = "beam"
modes = 4                                  # the lowest four frequencies are measured
measurement_noise = { relative = 0.002 }   # standard deviation of one measured frequency, relative

[[node]]
name = "abutment"
x_m = 0.0
support = "pinned"
[[node]]
name = "pier"
x_m = 12.0
[[node]]
name = "end"
x_m = 20.0
support = "pinned"

[[beam]]
name = "west"
from = "abutment"
to = "pier"
bending_stiffness_n_m2 = 4.0e8             # EI, N·m²
mass_kg_per_m = 900.0
[[beam]]
name = "east"
from = "pier"
to = "end"
bending_stiffness_n_m2 = 4.0e8
mass_kg_per_m = 800.0

[[spring]]
name = "bearing"
from = "ground"
to = "pier"

# What is unknown. With scale = true it is a factor of the nominal stiffness above, and its results are in per cent of that. The
# prior is the range in which the value can lie, damaged or not.
[[parameter]]
name = "west_ei"
scale = true
prior = { uniform = [0.5, 1.5] }
sets = { beam = "west" }
[[parameter]]
name = "east_ei"
scale = true
prior = { uniform = [0.5, 1.5] }
sets = { beam = "east" }
# The bearing is hardly known: its stiffness itself, N/m, without a nominal value.
[[parameter]]
name = "bearing"
prior = { uniform = [0.5e7, 3.0e7] }
sets = { spring = "bearing" }
`;

const TEMPLATES = { building: BUILDING, bridge: BRIDGE };

/** Opens the dialog; after the structure has been stored, its page is shown. */
export async function describe() {
  const text = h("textarea", { id: "describe-text", class: "code", rows: 18, spellcheck: false, name: "text" });
  text.value = BUILDING;
  const template = h(
    "select",
    { id: "describe-template", onchange: () => (text.value = TEMPLATES[template.value]) },
    h("option", { value: "building" }, "Building: masses on springs"),
    h("option", { value: "bridge" }, "Bridge: beam on supports"),
  );
  const stored = await ask({
    title: "Describe a structure",
    body: [
      h(
        "p",
        null,
        "Change the numbers and names of a template to those of your structure. The service checks the text before it stores it. The ",
        h("a", { href: "docs/structure-file", target: "_blank", rel: "noopener" }, "structure file"),
        " explains every key.",
      ),
      h("p", { class: "field" }, h("label", { for: "describe-template" }, "Template"), template),
      h("p", { class: "field" }, h("label", { for: "describe-text" }, "Structure file (TOML)"), text),
    ],
    confirm: "Check and store",
    submit: async () => {
      const id = /^\s*id\s*=\s*"([^"]*)"/m.exec(text.value)?.[1];
      if (!id)
        throw Object.assign(new Error('The text needs a line such as id = "my-building".'), { title: "No id" });
      const options = { method: "PUT", headers: { "content-type": "application/toml" }, body: text.value };
      return (await request(`v1/structures/${encodeURIComponent(id)}`, options)).json();
    },
  });
  if (!stored) return;
  notify(`Structure ${stored.id} has been stored. Next: train its model.`);
  // Doubts such as a prior in factors where a stiffness is expected.
  (stored.notes ?? []).forEach((note) => notify(`Please check: ${note}`, "error"));
  location.hash = `#/structures/${encodeURIComponent(stored.id)}?section=model`;
}
