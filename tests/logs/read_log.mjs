// Prints every message of an MCAP file as a line of JSON, read as Foxglove and Lichtblick read it.
import { open } from "node:fs/promises";
import { createRequire } from "node:module";

const [folder, path] = process.argv.slice(2);
const require = createRequire(`${folder}/package.json`);
const { McapIndexedReader } = require("@mcap/core");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { decompress } = require("fzstd");
const protobuf = require("protobufjs");
const { FileDescriptorSet } = require("protobufjs/ext/descriptor");

const file = await open(path);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, Number(length), Number(offset));
    return buffer;
  },
};
const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const decoders = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  if (channel.messageEncoding === "protobuf") {
    const root = protobuf.Root.fromDescriptor(FileDescriptorSet.decode(schema.data));
    const type = root.resolveAll().lookupType(schema.name);
    const readable = { defaults: true, enums: String, longs: Number };
    const decode = (data) => type.toObject(type.decode(data), readable);
    decoders.set(channel.id, [channel.topic, decode]);
  } else {
    const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
    const decoder = new MessageReader(definition);
    decoders.set(channel.id, [channel.topic, (data) => decoder.readMessage(data)]);
  }
}
const plain = (key, value) => {
  if (ArrayBuffer.isView(value)) return Array.from(value, (item) => plain("", item));
  if (typeof value === "bigint") return value.toString();
  return typeof value === "number" && !Number.isFinite(value) ? String(value) : value;
};
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const [topic, decode] = decoders.get(message.channelId);
  const values = decode(message.data);
  console.log(JSON.stringify({ topic, time: message.logTime, values }, plain));
}
