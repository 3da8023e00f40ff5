// the one call that npm canopen makes of node-crc, without its native code: CRC-16 of block transfers
exports.crc = (width, reflectIn, polynomial, high, low, x, y, z, data) => {
  let register = 0;
  for (const byte of data) {
    register ^= byte << 8;
    for (let bit = 0; bit < 8; bit++) {
      register = register & 0x8000 ? (register << 1) ^ polynomial : register << 1;
    }
    register &= 0xffff;
  }
  return Buffer.from([register >> 8, register & 0xff]);
};
