/* Preloaded into user-mode Linux 6.1 on processors with AMX.
 *
 * That kernel keeps the registers of a process in a buffer that ends before the tiles of AMX. The
 * kernel of the host refuses a register set that is shorter than the host's register set. This library
 * adds the missing registers in their initial state, which a clear bit of XSTATE_BV marks.
 * Source: Intel SDM volume 1, 13.4.2; PTRACE_SETREGSET in ptrace(2).
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#define XSTATE_BV 512
#define KNOWN_TO_GUEST 0x3ffull /* bits 0 to 9: x87 to PKRU */

typedef long ptrace_function(int request, int pid, void *address, void *data);

long ptrace(enum __ptrace_request request, ...)
{
    static ptrace_function *next;
    static _Alignas(64) unsigned char whole[65536];
    static size_t host_length;
    __builtin_va_list given;
    __builtin_va_start(given, request);
    int pid = __builtin_va_arg(given, int);
    void *address = __builtin_va_arg(given, void *), *data = __builtin_va_arg(given, void *);
    __builtin_va_end(given);
    if (!next)
        next = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
    if (request != PTRACE_SETREGSET || (uintptr_t)address != NT_X86_XSTATE)
        return next(request, pid, address, data);
    struct iovec *wanted = data, room = {whole, sizeof whole};
    if (!host_length && next(PTRACE_GETREGSET, pid, address, &room) == 0)
        host_length = room.iov_len;
    if (wanted->iov_len >= host_length)
        return next(request, pid, address, data);
    memset(whole, 0, host_length);
    memcpy(whole, wanted->iov_base, wanted->iov_len);
    uint64_t present;
    memcpy(&present, whole + XSTATE_BV, sizeof present);
    present &= KNOWN_TO_GUEST;
    memcpy(whole + XSTATE_BV, &present, sizeof present);
    struct iovec filled = {whole, host_length};
    return next(request, pid, address, &filled);
}
