// Follows a map through `factorbus gateway`: every step in one line, until a revision that is asked for.
//
//     node watch.mjs http://127.0.0.1:8080 warehouse [REVISION]
//
// JavaScript has no Zenoh of its own (a browser none at all), so this goes through the gateway, which reads and does not
// insert. The rules of §7 hold: a step counts where its `previous` is our revision; anything else means the whole
// estimate again, which is what a new connection begins with.
const [root, name, last] = process.argv.slice(2);
if (!name) {
  console.error("usage: node watch.mjs http://HOST:PORT MAP [REVISION]");
  process.exit(2);
}
if (typeof WebSocket === "undefined") {
  console.error("this node has no WebSocket: take node 22 or newer, or node --experimental-websocket watch.mjs");
  process.exit(1);
}

const listed = await fetch(`${root}/api/maps`).then((answer) => answer.json());
if (listed.problem) {
  // For example `other_protocol`: the gateway, which speaks Zenoh for us, has looked for services of other versions (§13).
  console.error(`${listed.problem.message} [${listed.problem.code}]`);
  process.exit(1);
}
const row = listed.maps.find((each) => each.name === name);
if (!row) {
  console.error(`there is no map ${name}; there are: ${listed.maps.map((each) => each.name).join(", ") || "none"}`);
  process.exit(1);
}
console.log(`map ${name}: mode ${row.mode}, ${row.variables} variables, ${row.factors} factors`);

/** key -> value, of one revision of one epoch. */
let estimate = new Map();
let at = { epoch: "", revision: -1 };
follow();

function follow() {
  const socket = new WebSocket(`${root.replace(/^http/, "ws")}/api/maps/${name}/live`);
  socket.onmessage = (event) => {
    const step = JSON.parse(event.data);
    const whole = step.type === "estimate";
    if (!whole && (step.epoch !== at.epoch || step.previous > at.revision)) {
      console.log(`missed steps after revision ${at.revision}: connecting again`);
      socket.onclose = null;
      socket.close();
      return follow();
    }
    if (whole) estimate = new Map();
    for (const { keys, values } of step.variables) keys.forEach((key, i) => estimate.set(key, values[i]));
    at = { epoch: step.epoch, revision: step.revision };
    show(step);
    if (last !== undefined && at.revision >= Number(last)) {
      console.log("estimate", JSON.stringify(Object.fromEntries(estimate)));
      socket.onclose = null;
      socket.close();
    }
  };
  socket.onerror = () => console.error(`${root}: no connection`);
  socket.onclose = (event) => {
    console.error(`the connection ended${event.reason ? `: ${event.reason}` : ""}`);
    process.exitCode = 1;
  };
}

function show({ variables, report }) {
  const changed = variables.reduce((sum, group) => sum + group.keys.length, 0);
  const why = report?.because ? `, because ${report.because}` : "";
  console.log(`revision ${at.revision}: ${changed} of ${estimate.size} variables changed${why}`);
}
