// node gltf_validate.js FOLDER_OF_NODE_MODULES FILE...: prints the Khronos validator's issues of each file as JSON.
const fs = require("fs");
const path = require("path");
const [modules, ...files] = process.argv.slice(2);
const validator = require(path.join(modules, "gltf-validator"));
const all = files.map((file) => validator.validateBytes(new Uint8Array(fs.readFileSync(file))));
Promise.all(all).then((reports) => console.log(JSON.stringify(reports.map((report) => report.issues))));
