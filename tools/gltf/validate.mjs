// Judges .glb files with Khronos' validator. Fails on every error but one kind: the validator refuses attribute names
// with a colon, which KHR_gaussian_splatting prescribes. Prints one line a file and the messages that count.
import { createRequire } from 'node:module';
import { readFileSync } from 'node:fs';

const [modules, ...files] = process.argv.slice(2);
const validator = createRequire(modules + '/')('gltf-validator');
const allowed = (message) =>
  message.code === 'MESH_PRIMITIVE_INVALID_ATTRIBUTE' && /"KHR_gaussian_splatting:|\/KHR_gaussian_splatting:/.test(
    message.message + ' ' + message.pointer);

let failed = false;
for (const file of files) {
  const report = await validator.validateBytes(new Uint8Array(readFileSync(file)), { maxIssues: 0, uri: file });
  const messages = report.issues.messages;
  const counted = messages.filter((m) => m.severity <= 1 && !allowed(m));  // 0 error, 1 warning
  const info = report.info;
  console.log(`${file}: ${counted.length} problems, ${messages.filter(allowed).length} colon names; ` +
              `${info.drawCallCount} meshes, ${info.totalVertexCount} points, ${info.animationCount} animations`);
  for (const m of counted)
    console.log(`  ${m.severity === 0 ? 'error' : 'warning'} ${m.code} ${m.pointer ?? ''}: ${m.message}`);
  failed ||= counted.some((m) => m.severity === 0) || !(info.totalVertexCount > 0) || !(info.animationCount > 0);
}
process.exit(failed || files.length === 0 ? 1 : 0);
