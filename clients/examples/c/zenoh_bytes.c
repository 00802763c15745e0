#include "zenoh_bytes.h"

#include <string.h>

enum { EXT_BODY = 0x60, EXT_MORE = 0x80 };

uint8_t byte(reader *in)
{
    if (in->at >= in->end) {
        in->bad = true;
        return 0;
    }
    return *in->at++;
}

uint64_t number(reader *in)
{
    uint64_t value = 0;
    for (int shift = 0; shift < 56; shift += 7) {
        uint8_t next = byte(in);
        value |= (uint64_t)(next & 0x7f) << shift;
        if (!(next & 0x80)) return value;
    }
    return value | (uint64_t)byte(in) << 56;
}

reader part(reader *in, uint64_t size)
{
    reader inside = {in->at, in->at, in->bad};
    if (in->bad || size > (uint64_t)(in->end - in->at)) {
        in->bad = inside.bad = true;
        return inside;
    }
    in->at += size;
    inside.end = in->at;
    return inside;
}

void put(writer *out, const void *bytes, size_t size)
{
    if (size > sizeof out->bytes - out->size) {
        out->full = true;
        return;
    }
    if (size > 0) memcpy(out->bytes + out->size, bytes, size);
    out->size += size;
}

void put_byte(writer *out, uint8_t value) { put(out, &value, 1); }

void put_number(writer *out, uint64_t value)
{
    for (int i = 0; i < 8 && value > 0x7f; i++, value >>= 7) put_byte(out, (uint8_t)(value | 0x80));
    put_byte(out, (uint8_t)value);
}

void put_key(writer *out, const char *key)
{
    put_number(out, 0); /* no number stands for its beginning */
    put_number(out, strlen(key));
    put(out, key, strlen(key));
}

void skip_extensions(reader *in, uint8_t header)
{
    for (bool more = header & EXTENDED; more && !in->bad;) {
        uint8_t extension = byte(in);
        more = extension & EXT_MORE;
        if ((extension & EXT_BODY) == EXT_INT) number(in);
        if ((extension & EXT_BODY) == EXT_BYTES) part(in, number(in));
    }
}
