// node validate.js FILE...: the issues of every glTF file as one JSON object, {file: [{code, severity, message, pointer}]}.
const fs = require("fs");
const validator = require("gltf-validator");

(async () => {
  const found = {};
  for (const file of process.argv.slice(2)) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), { maxIssues: 100 });
    found[file] = report.issues.messages;
  }
  console.log(JSON.stringify(found));
})();
