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

# What is unknown. The prior is the range in which the value can lie, damaged or not, in N/m.
[[parameter]]
name = "storey1"
prior = { uniform = [5.0e7, 1.2e8] }
sets = { spring = "storey1" }

[[parameter]]
name = "storey2"
prior = { uniform = [4.0e7, 1.1e8] }
sets = { spring = "storey2" }
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
mass_kg_per_m = 900.0
[[beam]]
name = "east"
from = "pier"
to = "end"
mass_kg_per_m = 800.0

[[spring]]
name = "bearing"
from = "ground"
to = "pier"

# What is unknown. The prior is the range in which the value can lie, damaged or not.
[[parameter]]
name = "west_ei"
prior = { uniform = [2.0e8, 6.0e8] }       # N·m²
sets = { beam = "west" }
[[parameter]]
name = "east_ei"
prior = { uniform = [2.0e8, 6.0e8] }
sets = { beam = "east" }
[[parameter]]
name = "bearing"
prior = { uniform = [0.5e7, 3.0e7] }       # N/m
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
  location.hash = `#/structures/${encodeURIComponent(stored.id)}?section=model`;
}
