/* Zenoh's bytes: numbers, keys and extensions, read and written. */
#ifndef FACTORBUS_ZENOH_BYTES_H
#define FACTORBUS_ZENOH_BYTES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    BATCH = 65535,
    ID = 0x1f, F1 = 0x20, F2 = 0x40, EXTENDED = 0x80, /* of a header: which, two flags, extensions follow */
    EXT_INT = 0x20, EXT_BYTES = 0x40, /* of an extension: what it carries */
};

/* `bad` once something was asked for that is not there; what is read after that means nothing. */
typedef struct {
    const uint8_t *at, *end;
    bool bad;
} reader;

/* `full` once a batch could not hold it. */
typedef struct {
    uint8_t bytes[BATCH];
    size_t size;
    bool full;
} writer;

uint8_t byte(reader *in);
/* Seven bits a byte, the least first; the ninth byte has eight. */
uint64_t number(reader *in);
/* The next bytes, as many as are asked for. */
reader part(reader *in, uint64_t size);
void skip_extensions(reader *in, uint8_t header);

void put(writer *out, const void *bytes, size_t size);
void put_byte(writer *out, uint8_t value);
void put_number(writer *out, uint64_t value);
void put_key(writer *out, const char *key);

#endif
